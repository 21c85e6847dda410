"""What a controller is besides its network: gait, slew, trim and gains, kept in the weights file and read from it.

Defaults are those of the first controller, whose file says less; a new controller may differ in any of them.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.control.velocity_map import NUM_TERMS
from gym_demohlm.errors import SceneError
from gym_demohlm.robot import g1
from gym_demohlm.robot.physics import FIRST, Physics, named

NUM_TURN = 12


@dataclass(frozen=True, kw_only=True)
class Gait:
    """The walking reference.

    Attributes:
        period_s: Time of two steps [s].
        swing: Part of the period in which a foot is in the air; the right foot swings half a period after the left.
        lift: Height of the sole at mid-swing [m].
        sway: Amplitude of the lateral sway of the pelvis [m].
        widen: How much wider each foot stands for a sideways speed [m per m/s], so that the feet never cross.
        placement_s: Feet land this much further out for a velocity error [m per m/s]: Raibert's foot placement.
        inward: Share of that for a foot that would land towards the other one, where it has little room.
        spread: How far each foot walks beside the middle [m]; a robot at rest stands with its feet under its hips.
        recovery_s: How long a robot that was pushed walks wider and faster than it does otherwise [s]: fully in the
            first half of it, less and less in the second. 0 for never.
        recovery_speed: The error of velocity that tells a push [m/s], see ``gait_clock.pushed``.
        recovery_spread: ``spread`` of a robot that was pushed just now [m].
        recovery_period_s: ``period_s`` of a robot that was pushed just now [s].
        swing_upright: Share of an unplanned tilt of the pelvis that the swinging leg makes up for, to land where it
            would have landed without.
        ankle_upright: How far the ankles of the bearing legs turn against an unplanned tilt of the pelvis [rad/rad].
        ankle_damping_s: The same against its rate [rad per rad/s].
        turn: What both hip yaws add while walking [rad]: the cosine and sine of the gait's first harmonic, those of its
            third, then the same times the forward velocity [m/s]; the cosine and sine of its second times the sideways
            velocity [m/s], then times the yaw rate [rad/s]. These alone are the same in a mirror.
        capture: How far the capture point of a robot at rest may be ahead of, behind and beside where its weight
            should be [m] before it steps; without it, it steps by its speed alone.
    """

    period_s: float = 0.64
    swing: float = 0.4
    lift: float = 0.06
    sway: float = 0.025
    widen: float = 0.06
    placement_s: float = 0.12
    inward: float = 1.0
    spread: float = g1.HIP_SPREAD
    recovery_s: float = 0.0
    recovery_speed: float = 0.4
    recovery_spread: float = g1.HIP_SPREAD
    recovery_period_s: float = 0.64
    swing_upright: float = 0.0
    ankle_upright: float = 0.0
    ankle_damping_s: float = 0.0
    turn: tuple[float, ...] = (0.0,) * NUM_TURN
    capture: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        """Check what would divide by zero, index wrongly, cross the feet or put them under the floor.

        Raises:
            SceneError: What is no finite number, a period, swing, lift, spread or recovery out of range, or another
                number of them.
        """
        for entry in fields(self):
            value, count = getattr(self, entry.name), {"turn": NUM_TURN, "capture": 3}.get(entry.name)
            if count is None:
                _require_finite(entry.name, [value])
            elif value is not None:
                numbers = list(value) if isinstance(value, list | tuple | np.ndarray) else [value]
                _require_finite(entry.name, numbers)
                if len(numbers) != count:
                    got = f"{entry.name} of the gait with {len(numbers)} numbers"
                    raise SceneError(got, str(count), "check the file it was read from")
                object.__setattr__(self, entry.name, tuple(map(float, numbers)))
        if not (self.period_s > 0.1 and 0.05 < self.swing < 0.5 and len(self.turn) == NUM_TURN):
            got = f"a gait of period {self.period_s} s, swing {self.swing}, {len(self.turn)} coefficients of turning"
            raise SceneError(got, f"more than 0.1 s, 0.05 to 0.5, {NUM_TURN}", "check the file it was read from")
        if not (0.0 <= self.lift <= 0.5 and 0.0 < self.spread <= 0.5 and 0.0 < self.recovery_spread <= 0.5):
            got = f"a gait with lift {self.lift} m, spread {self.spread} m, recovery_spread {self.recovery_spread} m"
            raise SceneError(got, "0 to 0.5 m, and both spreads above 0", "check the file it was read from")
        if not (self.recovery_period_s > 0.1 and self.recovery_s >= 0.0 and self.recovery_speed > 0.0):
            got = f"a recovery of {self.recovery_s} s, {self.recovery_speed} m/s, period {self.recovery_period_s} s"
            raise SceneError(got, "0 or more, above 0, more than 0.1 s", "check the file it was read from")

    @property
    def rest_phases(self) -> tuple[float, float]:
        """Where the clock rests: just before a swing, where both feet are on the floor."""
        return 0.5 * (0.5 + self.swing), 0.5 + 0.5 * (0.5 + self.swing)


def _require_finite(name: str, values: Sequence[Any]) -> None:
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float | np.floating) or not math.isfinite(value):
            raise SceneError(f"{name}={value!r}", "a finite number", "check the file it was read from")


@dataclass(frozen=True, kw_only=True)
class Trim:
    """The slow correction of a command, see ``control.trim``.

    Attributes:
        rate: Error that is corrected in a second, as a share of what there is of it [1/s].
        fade: Correction that is lost in a second where there is nothing to learn, as a share of it [1/s].
        limits: Largest correction of yaw rate [rad/s]; torso height [m], roll, pitch and yaw [rad].
    """

    rate: float = 0.7
    fade: float = 2.0
    limits: tuple[float, float, float, float, float] = (0.25, 0.04, 0.08, 0.08, 0.08)


UNTRIMMED = Trim(rate=0.0, limits=(0.0, 0.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What a controller is besides its network.

    Attributes:
        gait: The walking reference.
        slew: Fastest change of the command's first seven numbers, per second.
        gain: Factor on each of these seven numbers before the policy gets them; on the torso's height, factor on its
            distance from the height at rest. A policy that walks too slowly gets a larger velocity.
        velocity_map: Coefficients of ``control.velocity_map`` for forward and sideways velocity [m/s]; empty for none.
        trim: The slow correction.
        stiffness: Position gains of the servos of ``g1.BODY_JOINTS`` [Nm/rad].
        damping: Their velocity gains [Nms/rad].
        physics: Of the robot that it was trained for and is simulated with.
    """

    gait: Gait = Gait()
    slew: tuple[float, ...] = (1.5, 1.5, 3.0, 0.4, 1.2, 1.2, 1.5)
    gain: tuple[float, ...] = (1.0,) * 7
    velocity_map: tuple[tuple[float, ...], ...] = ()
    trim: Trim = Trim()
    stiffness: tuple[float, ...] = tuple(g1.motor(joint).stiffness for joint in g1.BODY_JOINTS)
    damping: tuple[float, ...] = tuple(g1.motor(joint).damping for joint in g1.BODY_JOINTS)
    physics: Physics = FIRST

    def metadata(self) -> dict[str, Any]:
        """Return the settings as JSON holds them: what ``read`` takes."""
        return {
            "gait": dict(vars(self.gait)),
            "slew": list(self.slew),
            "gain": list(self.gain),
            "velocity_map": [list(row) for row in self.velocity_map],
            "trim": dict(vars(self.trim)),
            "stiffness": dict(zip(g1.BODY_JOINTS, self.stiffness, strict=True)),
            "damping": dict(zip(g1.BODY_JOINTS, self.damping, strict=True)),
            "physics": self.physics.name,
        }

    @classmethod
    def read(cls, metadata: Mapping[str, Any]) -> "Settings":
        """Return the settings in a weights file's metadata; what it does not mention is as it was at first.

        Raises:
            SceneError: A setting that is not known here, or numbers that are missing or too many.
            UnknownNameError: A physics that is not known here.
        """
        found = cls(
            gait=_read(Gait, metadata.get("gait", {}), "gait"),
            slew=tuple(metadata.get("slew", cls.slew)),
            gain=tuple(metadata.get("gain", cls.gain)),
            velocity_map=tuple(tuple(row) for row in metadata.get("velocity_map", cls.velocity_map)),
            trim=_read(Trim, metadata.get("trim", {}), "trim"),
            stiffness=_of_joints(metadata.get("stiffness", {}), cls.stiffness),
            damping=_of_joints(metadata.get("damping", {}), cls.damping),
            physics=named(metadata.get("physics", cls.physics.name)),
        )
        mapped = tuple(value for row in found.velocity_map for value in row)
        numbers = (*found.slew, *found.gain, *mapped, *found.trim.limits, *found.stiffness, *found.damping)
        sizes = len(found.slew), len(found.gain), len(mapped), len(found.trim.limits)
        expected = len(cls.slew), len(cls.gain), 2 * NUM_TERMS if found.velocity_map else 0, len(cls.trim.limits)
        if sizes != expected or not all(isinstance(value, int | float) and math.isfinite(value) for value in numbers):
            got = f"controller weights with slew, gain, velocity map and trim of {sizes} numbers, or some that are none"
            raise SceneError(got, f"{expected}, finite", "export the weights again")
        return found


def read_gait(path: Path) -> Gait:
    """Return the gait in a JSON file of ``Gait``'s settings.

    Raises:
        SceneError: The file is missing, is no JSON, or holds other settings.
    """
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise SceneError(f"{path} ({error})", "a JSON file of gait settings", "check --gait") from error
    return _read(Gait, content, "gait")


def _of_joints(values: Mapping[str, float], default: tuple[float, ...]) -> tuple[float, ...]:
    """Return a number for each of ``g1.BODY_JOINTS``: of a mapping, or where it lacks one, as it was at first."""
    return tuple(values.get(joint, first) for joint, first in zip(g1.BODY_JOINTS, default, strict=True))


def _read[T](kind: type[T], values: Mapping[str, Any], name: str) -> T:
    """Build a dataclass from what JSON holds, lists as tuples."""
    if not isinstance(values, Mapping):
        got = f"{name} settings {values!r}"
        raise SceneError(got, "a JSON object of names and values", "check the file they were read from")
    known = {entry.name for entry in fields(kind)}  # type: ignore[arg-type]
    if unknown := set(values) - known:
        raise SceneError(
            f"controller weights with the {name} settings {sorted(unknown)}",
            f"settings among {sorted(known)}",
            "install the version that they were exported with",
        )
    try:
        return kind(**{key: tuple(value) if isinstance(value, list) else value for key, value in values.items()})
    except TypeError as error:
        raise SceneError(
            f"controller weights with {name} settings that cannot be read ({error})",
            "numbers",
            "export the weights again",
        ) from error
