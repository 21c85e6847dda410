"""Angles of the neck and travels of the grippers <-> positions of four Dynamixel XC330 servos, 4096 steps a turn."""

import math
from dataclasses import dataclass

import numpy as np

from gym_demohlm.robot.hands import GRIPPER
from gym_demohlm.robot.neck import NECK_LOWER, NECK_UPPER

STEPS = 4096  # a turn
SPEED_STEP = 0.229 * 2 * math.pi / 60  # rad/s of one unit of present velocity
TORQUE_ENABLE, GOAL_POSITION, PRESENT_TEMPERATURE = 64, 116, 146
PRESENT_VELOCITY, PRESENT_POSITION = 128, 132
BUS_WATCHDOG, HARDWARE_ERROR = 98, 70
"""Addresses in the control table (https://emanual.robotis.com/docs/en/dxl/x/xc330-m288/)."""
WATCHDOG_UNITS = 10  # of 20 ms: a servo that hears nothing for so long stops by itself
WATCHDOG_ACTED = 255  # -1, of a byte: the servo has stopped, and takes no goal until 0 is written
HARDWARE_ERRORS = {0: "input voltage", 2: "overheating", 3: "encoder", 4: "electrical shock", 5: "overload"}
"""Bits of HARDWARE_ERROR. A servo with one lets go, and stays so until it is switched off or rebooted."""


@dataclass(frozen=True, kw_only=True)
class Servo:
    """One servo and what it moves.

    Attributes:
        id: On the bus.
        zero: Position at which what it moves is at zero [steps].
        ratio: Turn of the servo for what it moves [rad/rad or rad/m]; negative where it turns the other way.
        lower: Of what it moves [rad or m].
        upper: Of what it moves [rad or m].
    """

    id: int
    zero: int
    ratio: float
    lower: float
    upper: float

    def steps(self, value: float) -> int:
        """Return the goal position for a value [rad or m], within its limits."""
        inside = min(max(value, self.lower), self.upper)
        return round(self.zero + self.ratio * inside * STEPS / (2 * math.pi))

    def value(self, steps: int) -> float:
        """Return what a position means [rad or m]."""
        return (steps - self.zero) * 2 * math.pi / STEPS / self.ratio

    def speed(self, units: int) -> float:
        """Return what a present velocity means [rad/s or m/s]."""
        return units * SPEED_STEP / self.ratio


NECK = (
    Servo(id=1, zero=2048, ratio=1.0, lower=float(NECK_LOWER[0]), upper=float(NECK_UPPER[0])),
    Servo(id=2, zero=2048, ratio=1.0, lower=float(NECK_LOWER[1]), upper=float(NECK_UPPER[1])),
)
GRIPPERS = tuple(
    Servo(id=index, zero=512, ratio=1.0 / GRIPPER.pinion_radius, lower=0.0, upper=GRIPPER.stroke) for index in (3, 4)
)


def goals(neck: np.ndarray, grippers: np.ndarray, has_grippers: bool) -> dict[int, int]:
    """Return goal positions by id [steps].

    Args:
        neck: (2,) angles [rad].
        grippers: (2,) from 0, open, to 1, closed.
        has_grippers: Whether the robot has any.
    """
    found = {servo.id: servo.steps(float(angle)) for servo, angle in zip(NECK, neck, strict=True)}
    if has_grippers:
        pairs = zip(GRIPPERS, grippers, strict=True)
        found |= {servo.id: servo.steps(GRIPPER.stroke * float(share)) for servo, share in pairs}
    return found
