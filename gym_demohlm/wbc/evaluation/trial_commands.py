"""A random generator -> what the benchmark asks of the controller: commands and arm motions of many worlds."""

from dataclasses import dataclass, replace

import numpy as np

from gym_demohlm.control import command, reference
from gym_demohlm.robot import g1
from gym_demohlm.timing import STEP_DT
from gym_demohlm.wbc.evaluation.commanded_posture import Figure

_NEW_ARMS = 0.05  # chance a tick that arms get a new goal
_TRIES = 20  # arm poses, before the arms stay where they are
_ALONG_THE_WAY = (1.0, 0.5, 0.25, 0.75)


@dataclass(frozen=True, kw_only=True)
class CommandRange:
    """What commands are drawn from, uniformly; (low, high) each.

    Attributes:
        forward, sideways: [m/s].
        yaw_rate: [rad/s].
        height: Standing [m].
        pitch, roll, yaw: Torso, standing [rad].
        walking_height: [m].
        walking_pitch: [rad].
        arm_speed: [rad/s].
    """

    forward: tuple[float, float] = (-0.5, 0.8)
    sideways: tuple[float, float] = (-0.4, 0.4)
    yaw_rate: tuple[float, float] = (-1.0, 1.0)
    height: tuple[float, float] = (0.40, 0.76)
    pitch: tuple[float, float] = (-0.3, 1.2)
    roll: tuple[float, float] = (-0.4, 0.4)
    yaw: tuple[float, float] = (-1.0, 1.0)
    walking_height: tuple[float, float] = (0.60, 0.76)
    walking_pitch: tuple[float, float] = (-0.3, 0.3)
    arm_speed: tuple[float, float] = (0.3, 3.0)

    def scaled(self, share: float) -> "CommandRange":
        """Return the range drawn together about the robot at rest; only the arms' speed stays."""
        rest = {"height": g1.PELVIS_HEIGHT, "walking_height": g1.PELVIS_HEIGHT}
        drawn = {
            name: (rest.get(name, 0.0) * (1 - share) + share * low, rest.get(name, 0.0) * (1 - share) + share * high)
            for name, (low, high) in vars(self).items()
            if name != "arm_speed"
        }
        return replace(self, **drawn)

    def upright(self) -> "CommandRange":
        """Return the range with its velocities and moving arms: an upright torso at rest height."""
        height, zero = (g1.PELVIS_HEIGHT, g1.PELVIS_HEIGHT), (0.0, 0.0)
        still = {name: zero for name in ("pitch", "roll", "yaw", "walking_pitch")}
        return replace(self, height=height, walking_height=height, **still)

    def velocity_only(self) -> "CommandRange":
        """Return the range with its velocities alone: upright at rest height, arms still."""
        return replace(self.upright(), arm_speed=(0.0, 0.0))


# Arm poses in front of and beside the body [rad]: shoulder pitch, roll, yaw, elbow, wrist roll, pitch, yaw; left arm.
_ARM_LOW = np.array([-1.8, -0.1, -0.8, -0.9, -0.8, -0.8, -0.8])
_ARM_HIGH = np.array([0.6, 1.2, 0.8, 1.5, 0.8, 0.8, 0.8])
ARM_MIRROR = np.array([1.0, -1.0, -1.0, 1.0, -1.0, 1.0, -1.0])


class Driver:
    """Draws commands and arm motions for all worlds.

    Arms go to poses that they reach at the commanded posture without being stopped by the robot's own body: a hand that
    is pressed on a thigh is no matter of how well a torso follows its commands.

    Attributes:
        walks: (N,) bool, who is asked to walk.
        commands: (N, 23).
    """

    def __init__(self, ranges: CommandRange, num_worlds: int, rng: np.random.Generator, figure: Figure) -> None:
        self.ranges, self.rng, self._figure = ranges, rng, figure
        self.walks = np.arange(num_worlds) % 2 == 0
        self.commands = np.tile(command.rest(), (num_worlds, 1))
        self._arm_goal = self.commands[:, command.ARMS].copy()
        self._arm_speed = np.zeros(num_worlds)

    def redraw(self) -> None:
        """Draw new commands; worlds swap between standing and walking."""
        rng, ranges, n = self.rng, self.ranges, len(self.commands)
        self.walks = ~self.walks
        before, walks = self.commands.copy(), self.walks.astype(float)
        draw = {name: rng.uniform(low, high, n) for name, (low, high) in vars(ranges).items()}
        velocity = np.stack([draw["forward"], draw["sideways"], draw["yaw_rate"]], axis=1)
        self.commands[:, command.VELOCITY] = velocity * walks[:, None]
        self.commands[:, command.HEIGHT] = np.where(self.walks, draw["walking_height"], draw["height"])
        self.commands[:, command.PITCH] = np.where(self.walks, draw["walking_pitch"], draw["pitch"])
        self.commands[:, command.ROLL] = np.where(self.walks, 0.0, draw["roll"])
        self.commands[:, command.YAW] = np.where(self.walks, 0.0, draw["yaw"])
        for world in range(n):
            self._draw_arms(world, before[world])

    def step(self) -> np.ndarray:
        """Move the arms on and return the commands (N, 23)."""
        for world in np.flatnonzero(self.rng.random(len(self.commands)) < _NEW_ARMS):
            self._draw_arms(world, self.commands[world])
        arms, step = self.commands[:, command.ARMS], self._arm_speed[:, None] * STEP_DT
        self.commands[:, command.ARMS] = arms + np.clip(self._arm_goal - arms, -step, step)
        return self.commands.copy()

    def _draw_arms(self, world: int, before: np.ndarray) -> None:
        """Draw where the arms of a world go while its posture changes from that of a command (23,) to the new one."""
        rng, wanted = self.rng, self.commands[world]
        if self.ranges.arm_speed[1] == 0.0:
            return
        arms = wanted[command.ARMS].copy()
        in_the_way = self._collides(wanted, arms)
        self._arm_speed[world] = self.ranges.arm_speed[1] if in_the_way else rng.uniform(*self.ranges.arm_speed)
        for _ in range(_TRIES):
            left, right = rng.uniform(_ARM_LOW, _ARM_HIGH, (2, len(_ARM_LOW)))
            goal = np.concatenate([left, right * ARM_MIRROR])
            path = ((before + share * (wanted - before), arms + share * (goal - arms)) for share in _ALONG_THE_WAY)
            if not any(self._collides(*there) for there in path):
                self._arm_goal[world] = goal
                return
        self._arm_goal[world] = arms

    def _collides(self, wanted: np.ndarray, arms: np.ndarray) -> bool:
        """Return whether the robot would touch itself at the posture of a command (23,) with these arms (14,)."""
        posture, still = wanted.copy(), np.ones(1, dtype=bool)
        posture[command.ARMS] = arms
        posture[: command.ARMS.start] = reference.admissible(posture[None], posture[None], still)[0]
        self._figure.stand(posture)
        return self._figure.collides()
