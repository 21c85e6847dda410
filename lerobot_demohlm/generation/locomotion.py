"""Where the base is and where it should stand -> velocity commands, until it stands there: the locomotion stage."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import dot, norm, transposed_product
from gym_demohlm.control import command, gait_clock
from gym_demohlm.timing import STEP_DT


@dataclass(frozen=True, kw_only=True)
class LocomotionSettings:
    """The PD controller, with an integral term, that walks the base to its goal.

    Attributes:
        position_gain: Velocity a metre of error [1/s].
        yaw_gain: Yaw rate a radian of error [1/s].
        damping: Share of the measured velocity that is taken off the command.
        max_velocity: Fastest forward, backward, sideways [m/s] and yaw rate [rad/s].
        straight: Whether the way is straight: a velocity beyond a limit is then shortened as a whole. Otherwise each
            axis is, which is faster and bends the way.
        integral_gain: Velocity a second of an error of one metre or radian [1/s^2]: a gait answers slow commands with
            a bias of its own.
        max_bias: Largest velocity that the integral adds [m/s, m/s, rad/s].
        bias_within: Errors larger than this are not integrated [m, m, rad].
        window_ticks: Ticks over which the base is averaged, a period of the gait, whose sway is no error.
        coast_s: Time for which the robot keeps its speed after a command to stand [s].
        settle_shift: Motion of the base, in its own frame, while the robot steps its feet square after a walk
            [m, m, rad]; fitted to the default controller.
        standoff: Metres to stay back from the goal for each metre of sideways error: the robot lines up first and then
            steps in.
        standoff_yaw: Metres to stay back from the goal for each radian of heading error.
        max_standoff: Largest distance to stay back from the goal [m].
        free_error: Sideways error up to which the robot does not stay back [m].
        tolerance_m: A walk stops where the robot would come to stand within this distance of the goal.
        tolerance_rad: A walk stops where the robot would come to stand within this heading error.
        accept_m: Largest distance from the goal at which a robot that stands still goes on to the next stage.
        accept_rad: Largest heading error with which a robot that stands still goes on to the next stage.
        settle_ticks: Ticks to stand still after a walk, while the controller squares up the feet.
        max_walks: Number of walks before the attempt gives up.
        max_ticks: Largest number of ticks of the locomotion stage.
    """

    position_gain: float = 1.2
    yaw_gain: float = 1.4
    damping: float = 0.3
    max_velocity: tuple[float, float, float, float] = (0.45, 0.25, 0.25, 0.5)
    straight: bool = False
    integral_gain: float = 0.6
    max_bias: tuple[float, float, float] = (0.12, 0.1, 0.2)
    bias_within: tuple[float, float, float] = (0.2, 0.15, 0.3)
    window_ticks: int = 7
    coast_s: float = 0.15
    settle_shift: tuple[float, float, float] = (-0.02, 0.0, 0.0)
    standoff: float = 1.2
    standoff_yaw: float = 0.35
    max_standoff: float = 0.25
    free_error: float = 0.05
    tolerance_m: float = 0.03
    tolerance_rad: float = 0.05
    accept_m: float = 0.06
    accept_rad: float = 0.17
    settle_ticks: int = 12
    max_walks: int = 4
    max_ticks: int = 140


class BaseEstimate:
    """Where the base is and how fast it goes, with the sway of the gait averaged out.

    Args:
        window_ticks: Period of the gait.

    Attributes:
        position: (3,) x, y, yaw now [m, m, rad].
        velocity: (3,) in the world [m/s, m/s, rad/s].
    """

    def __init__(self, window_ticks: int) -> None:
        self._window = window_ticks
        self._seen: list[np.ndarray] = []
        self.position, self.velocity = np.zeros(3), np.zeros(3)

    def update(self, T_world_pelvis: np.ndarray) -> None:
        """Take in the pose of this tick."""
        here = poses.to_planar(T_world_pelvis)
        if self._seen:
            here[2] = self._seen[-1][2] + poses.wrap_angle(here[2] - self._seen[-1][2])
        self._seen = [*self._seen[-self._window :], here]
        span = (len(self._seen) - 1) * STEP_DT
        if span > 0:
            self.velocity = (self._seen[-1] - self._seen[0]) / span
        self.position = np.mean(self._seen, axis=0) + 0.5 * span * self.velocity


class OffCourseError(Exception):
    """The base did not come to stand at its goal."""


def walk(
    pelvis: Callable[[], np.ndarray], goal: np.ndarray, settings: LocomotionSettings | None = None
) -> Iterator[np.ndarray]:
    """Yield commands (23,) at 10 Hz until the base stands at its goal.

    Args:
        pelvis: Returns its pose (4, 4) in the world, measured.
        goal: (3,) x, y, yaw [m, m, rad].
        settings: Gains, limits and tolerances.

    Raises:
        OffCourseError: It did not get there.
    """
    settings = settings or LocomotionSettings()
    ticks, bias = 0, np.zeros(3)
    base = BaseEstimate(settings.window_ticks)
    base.update(pelvis())
    shift = np.array(settings.settle_shift)  # learnt anew at a stop that missed the goal
    for _ in range(settings.max_walks):
        while ticks < settings.max_ticks:
            standing = _moved(_coasted(base, settings), shift)
            distance, turn = _errors(standing, goal)
            bias = _integrate(bias, standing, goal, settings)
            velocity = walk_velocity(standing, base.velocity, goal, settings, bias)
            arrived = distance < settings.tolerance_m and abs(turn) < settings.tolerance_rad
            if arrived or (np.abs(velocity) < gait_clock.WALK_THRESHOLD).all():  # so slow that it would stand
                break
            yield _with_velocity(velocity)
            ticks += 1
            base.update(pelvis())
        coasted = _coasted(base, settings)
        for _ in range(settings.settle_ticks):
            yield _with_velocity(np.zeros(3))
            ticks += 1
            base.update(pelvis())
        here = poses.to_planar(pelvis())
        distance, turn = _errors(here, goal)
        if distance < settings.accept_m and abs(turn) < settings.accept_rad:
            return
        if ticks >= settings.max_ticks:
            break
        shift = poses.to_planar(poses.invert(poses.planar(*coasted)) @ poses.planar(*here))
    raise OffCourseError


def _coasted(base: BaseEstimate, settings: LocomotionSettings) -> np.ndarray:
    """Return where the base (3,) comes to a halt, were it told to stand now."""
    return base.position + settings.coast_s * base.velocity


def _moved(base: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return a base (3,) moved by a shift (3,) in its own frame."""
    return poses.to_planar(poses.planar(*base) @ poses.planar(*shift))


def walk_velocity(
    here: np.ndarray,
    velocity: np.ndarray,
    goal: np.ndarray,
    settings: LocomotionSettings,
    bias: np.ndarray | None = None,
) -> np.ndarray:
    """Return the PD controller's velocity command (3,) in the heading frame [m/s, m/s, rad/s].

    Args:
        here: (3,) x, y, yaw of the base [m, m, rad].
        velocity: (3,) of the base in the world [m/s, m/s, rad/s].
        goal: (3,) where it should be.
        settings: Gains and limits.
        bias: (3,) added in the heading frame [m/s, m/s, rad/s]; none by default.
    """
    ahead = poses.planar(*goal)[:2, 0]
    offset = goal[:2] - here[:2]
    sideways = abs(float(dot(offset, np.array([-ahead[1], ahead[0]]))))
    turn = float(poses.wrap_angle(goal[2] - here[2]))
    hold = settings.standoff * max(0.0, sideways - settings.free_error)
    hold += settings.standoff_yaw * max(0.0, abs(turn) - 0.1)
    offset = offset - min(hold, settings.max_standoff) * ahead
    R = poses.planar(0.0, 0.0, here[2])[:2, :2]
    linear = transposed_product(R, settings.position_gain * offset - settings.damping * velocity[:2])
    angular = settings.yaw_gain * turn - settings.damping * velocity[2]
    wanted = np.append(linear, angular) + (0.0 if bias is None else bias)
    forward, backward, side, yaw_rate = settings.max_velocity
    if settings.straight:
        limits = (forward if wanted[0] > 0.0 else backward, side)
        wanted[:2] *= min(1.0, *(limit / max(abs(speed), 1e-9) for limit, speed in zip(limits, wanted, strict=False)))
    return np.clip(wanted, [-backward, -side, -yaw_rate], [forward, side, yaw_rate])


def _integrate(bias: np.ndarray, here: np.ndarray, goal: np.ndarray, settings: LocomotionSettings) -> np.ndarray:
    """Return the bias (3,) after one more tick with this error; large errors are the walk itself."""
    error = poses.to_planar(poses.invert(poses.planar(*here)) @ poses.planar(*goal))
    if (np.abs(error) > settings.bias_within).any():
        return bias
    return np.clip(bias + settings.integral_gain * STEP_DT * error, -np.array(settings.max_bias), settings.max_bias)


def _errors(here: np.ndarray, goal: np.ndarray) -> tuple[float, float]:
    offset = goal - here
    return float(norm(offset[:2])), float(poses.wrap_angle(offset[2]))


def _with_velocity(velocity: np.ndarray) -> np.ndarray:
    walking = command.rest()
    walking[command.VELOCITY] = velocity
    return walking
