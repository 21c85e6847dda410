"""LeRobot's interface of a robot <-> a G1 in a simulated world, or on a network: 68 numbers seen, 23 sent."""

import functools
import math
import re
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from lerobot.robots.robot import Robot

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.registry import get_task
from lerobot_demohlm.devices import live
from lerobot_demohlm.devices.config_g1 import DemoHLMG1Config, DeviceError
from lerobot_demohlm.teleop.clutch import WALK_SPEED

if TYPE_CHECKING:
    from lerobot_demohlm.devices.dds import DdsRobot

_STICKS = {"remote.ly": (0, 1.0), "remote.lx": (1, -1.0), "remote.rx": (2, -1.0)}  # of LeRobot's unitree_g1


class DemoHLMG1(Robot):
    """The Unitree G1 in the world of a task.

    An action may hold any of ``command.NAMES``; what it leaves out stays as it is, but
    velocities are 0 then.
    The arms' ``kLeftShoulderPitch.q`` and the sticks ``remote.lx`` of LeRobot's own ``unitree_g1`` mean the same joints
    and velocities. Other keys mean nothing here.

    Args:
        config: Task, pace and starts.
    """

    config_class = DemoHLMG1Config
    name = "unitree_g1"  # LeRobot sends observations to a teleoperator of a robot with this name alone

    def __init__(self, config: DemoHLMG1Config) -> None:
        super().__init__(config)
        self.config, self.task = config, get_task(config.task)
        self.cameras: dict[str, Any] = {}
        self._world: live.LiveWorld | DdsRobot | None = None
        self._last = command.rest()
        self._unhook: Callable[[], None] = lambda: None

    @property
    def observation_features(self) -> dict[str, type]:
        """The robot's own state; behind it the tracked objects, where the options ask for them."""
        names = observation.STATE_NAMES
        if self.config.objects:
            names += observation.environment_names(self.task)
        return dict.fromkeys(names, float)

    @property
    def action_features(self) -> dict[str, type]:
        """The command of the whole-body controller."""
        return dict.fromkeys(command.NAMES, float)

    @property
    def is_connected(self) -> bool:
        """Whether there is a world."""
        return self._world is not None

    @property
    def is_calibrated(self) -> bool:
        """Whether it needs no calibration: it never does."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Make the world, in which the robot stands where an operator takes over; or have a robot stand and run."""
        config = self.config
        if self._world is not None:
            raise DeviceError("a second connection", "one", "disconnect first")
        if config.backend == "dds":
            from lerobot_demohlm.devices.dds import DdsRobot  # needs the extra g1

            self._world = DdsRobot(config, self.task)
            shown = self._world.mirror
        else:
            by_clock = config.pace == "clock"
            self._world = live.LiveWorld(self.task, config.region, config.seed, config.spread, by_clock=by_clock)
            shown = self._world
        live.set_current(shown)
        self._last = command.rest()
        self._unhook = _follow_episodes(shown, self.reset)

    def calibrate(self) -> None:
        """Do nothing: there is nothing to calibrate."""

    def configure(self) -> None:
        """Do nothing: there is nothing to configure."""

    def reset(self) -> None:
        """Begin anew at the next start, if anything has happened since the last one."""
        world = self._connected()
        if world.seen.step > 0:
            world.reset()
            if not world.stays:
                self._last = command.rest()

    def get_observation(self) -> dict[str, Any]:
        """Return the numbers of ``observation_features``."""
        seen = self._connected().seen
        values = dict(zip(observation.STATE_NAMES, seen.state.tolist(), strict=True))
        if self.config.objects:
            names = observation.environment_names(self.task)
            values |= dict(zip(names, seen.environment_state.tolist(), strict=True))
        return values

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Have the robot do something; returns what it was told, within its bounds."""
        world = self._connected()
        wanted = self._last.copy()
        wanted[command.VELOCITY] = 0.0
        for name, value in action.items():
            column, number = _column(name), float(value)
            if column is None:
                continue
            if name in _STICKS:
                low, high = WALK_SPEED[column]
                pushed = _STICKS[name][1] * number
                number = -low * pushed if pushed < 0 else high * pushed
            wanted[column] = number
        if not np.isfinite(wanted).all():
            raise DeviceError("an action with NaN or infinity", "finite numbers", "check what computed it")
        wanted = command.clip(wanted[None])[0][0]
        self._last = wanted
        world.send(wanted)
        return dict(zip(command.NAMES, wanted.tolist(), strict=True))

    def disconnect(self) -> None:
        """End the world; a robot brakes its motors."""
        world = self._connected()
        self._unhook()
        live.set_current(None)
        self._world = None
        world.close()

    def _connected(self) -> "live.LiveWorld | DdsRobot":
        if self._world is None:
            raise DeviceError("a robot that is not connected", "connect() first", "connect it")
        return self._world


@functools.cache
def _column(name: str) -> int | None:
    """Return which number of a command a key means; None where it means none."""
    if name in command.NAMES:
        return command.NAMES.index(name)
    if name in _STICKS:
        return _STICKS[name][0]
    found = re.fullmatch(r"k(\w+)\.q", name)
    if found is None:
        return None
    plain = re.sub(r"(?<!^)(?=[A-Z])", "_", found[1]).lower() + ".pos"
    columns = range(command.SIZE)[command.ARMS]
    return command.NAMES.index(plain) if plain in command.NAMES and command.NAMES.index(plain) in columns else None


def _follow_episodes(shown: live.Operated, begin: Callable[[], None]) -> Callable[[], None]:
    """Have something done whenever a dataset of this process has stored an episode or dropped it; returns the undoing.

    LeRobot tells a robot nothing of episodes. The world must begin anew between the last frame of one and the first of
    the next, and nowhere else. So ``shown.framed_s`` says when the present one got its newest frame.
    """
    from lerobot.datasets import LeRobotDataset

    originals = {name: getattr(LeRobotDataset, name) for name in ("add_frame", "save_episode", "clear_episode_buffer")}

    def followed(original: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(original)
        def call(*arguments: Any, **options: Any) -> Any:  # noqa: ANN401
            result = original(*arguments, **options)
            if original is originals["add_frame"]:
                shown.framed_s = time.monotonic()
            else:
                shown.framed_s = -math.inf
                begin()
            return result

        return call

    for name, original in originals.items():
        setattr(LeRobotDataset, name, followed(original))

    def undo() -> None:
        for name, original in originals.items():
            setattr(LeRobotDataset, name, original)

    return undo
