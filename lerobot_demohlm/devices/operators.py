"""Operators of this project -> LeRobot's interface of a teleoperator: poses of palms and sticks, as 23 numbers.

A teleoperator sees the world of the robot that its process has connected (``live``). It solves once for each step of
the world, however often LeRobot asks.
"""

import json
import threading
import time
from abc import abstractmethod
from typing import Any

from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.keyboard_input import pynput_can_capture

from gym_demohlm.control import command
from gym_demohlm.control.ik import WholeBodyIK
from gym_demohlm.envs import observation
from gym_demohlm.errors import DemoHLMError
from gym_demohlm.timing import STEP_DT
from lerobot_demohlm.devices import live
from lerobot_demohlm.devices.config_operators import (
    DemoHLMGamepadConfig,
    DemoHLMKeyboardConfig,
    DemoHLMScriptConfig,
    DemoHLMWebConfig,
    _PageConfig,
)
from lerobot_demohlm.teleop.clutch import Clutch, Controls
from lerobot_demohlm.teleop.operator import Operator, OperatorPoses
from lerobot_demohlm.teleop.record import script_of
from lerobot_demohlm.teleop.recorder import solve
from lerobot_demohlm.teleop.session import SessionError
from lerobot_demohlm.teleop.status import ENGAGED, IDLE, Status
from lerobot_demohlm.teleop.web.server import TeleopServer

EPISODE_OVER_S = 1.0  # without a frame, after which an episode that LeRobot has not stored yet gets no more
ELSEWHERE = "recorded by LeRobot: its keys are at the terminal"
HEARD = (
    "recorded by LeRobot, which hears the keys of this page, too: right arrow and N end its episode, left arrow and R "
    "drop it, Esc and Q end all; move the robot by mouse, gamepad, phone or headset"
)


class _Operating(Teleoperator):
    """What all of them share: a clutch or script of their own, and the solver."""

    def __init__(self, config: Any) -> None:  # noqa: ANN401  any of the options
        super().__init__(config)
        self._on = False
        self._last = command.rest()
        self._ik: WholeBodyIK | None = None
        self._world: live.Operated | None = None
        self._at = (-1, -1)  # episode and step that the last action is for

    @property
    def action_features(self) -> dict[str, type]:
        """The command of the whole-body controller."""
        return dict.fromkeys(command.NAMES, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """The robot's state."""
        return dict.fromkeys(observation.STATE_NAMES, float)

    @property
    def is_connected(self) -> bool:
        """Whether ``connect`` was called."""
        return self._on

    @property
    def is_calibrated(self) -> bool:
        """There is nothing to calibrate."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Be ready."""
        self._on = True

    def calibrate(self) -> None:
        """Do nothing: there is nothing to calibrate."""

    def configure(self) -> None:
        """Do nothing: there is nothing to configure."""

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Take no notice: the world itself is seen."""

    def disconnect(self) -> None:
        """Let go."""
        self._on, self._world = False, None

    def get_action(self) -> dict[str, float]:
        """Return the command of this moment; that of a robot at rest before there is one."""
        world = live.current()
        if world is not None:
            if world is not self._world:
                self._world, self._ik, self._at = world, WholeBodyIK(world.sim.model), (-1, -1)
                self._enter(world)
            self._follow(world, self._ik)
        return dict(zip(command.NAMES, self._last.tolist(), strict=True))

    def _follow(self, world: live.Operated, ik: WholeBodyIK | None) -> None:
        seen = world.seen
        if ik is None or (seen.episode, seen.step) == self._at:
            return
        if seen.episode != self._at[0]:
            goes_on = world.stays and self._at[0] >= 0
            if not goes_on:
                self._last = command.rest()
            self._begin(world, goes_on=goes_on)
        self._at = seen.episode, seen.step
        asked = self._ask(seen)
        if asked is None:
            self._last = self._last.copy()
            self._last[command.VELOCITY] = 0.0
            return
        wanted, _ = solve(ik, seen.view.T_world_pelvis, seen.joint_positions, asked, self._last, self._walking(asked))
        self._last = wanted

    def _walking(self, asked: OperatorPoses) -> bool:
        """Return whether the torso must stay where the controller lets it while it steps."""
        return bool(asked.velocity.any())

    def _enter(self, world: live.Operated) -> None:
        """See a world for the first time."""

    @abstractmethod
    def _begin(self, world: live.Operated, *, goes_on: bool) -> None:
        """Begin an episode; ``goes_on`` tells whether the robot is still as the last action had it."""

    @abstractmethod
    def _ask(self, seen: live.Seen) -> OperatorPoses | None:
        """Return what the robot should do in this step; None to hold."""


class DemoHLMScript(_Operating):
    """The scripted operator of the robot's task: once through its motion in every episode."""

    config_class = DemoHLMScriptConfig
    name = "demohlm_script"

    def __init__(self, config: DemoHLMScriptConfig) -> None:
        super().__init__(config)
        self._operator: Operator | None = None

    def _begin(self, world: live.Operated, *, goes_on: bool) -> None:
        self._operator = script_of(world.task).make_operator()

    def _ask(self, seen: live.Seen) -> OperatorPoses | None:
        return None if self._operator is None else self._operator.poses(seen.view)

    def _walking(self, asked: OperatorPoses) -> bool:
        return False


class DemoHLMWeb(_Operating):
    """A person at a page: it is served as soon as there is a world to show, and its address printed."""

    config_class: Any = DemoHLMWebConfig
    name = "demohlm_web"

    def __init__(self, config: _PageConfig) -> None:
        super().__init__(config)
        self.config = config
        self._clutch = Clutch(config.scale)
        self._stage: _Stage | None = None

    def disconnect(self) -> None:
        """Stop serving."""
        if self._stage is not None:
            self._stage.close()
            self._stage = None
        super().disconnect()

    def _enter(self, world: live.Operated) -> None:
        if self._stage is not None:
            self._stage.close()
        self._stage = _Stage(world, self.config, self._clutch)

    def _begin(self, world: live.Operated, *, goes_on: bool) -> None:
        if goes_on:
            self._clutch.rebase(world.seen.view)
        else:
            self._clutch.reset()

    def _ask(self, seen: live.Seen) -> OperatorPoses | None:
        assert self._stage is not None  # get_action enters the world first
        asked = self._clutch.poses(self._stage.server.inputs.latest(), seen.view)
        self._stage.targets = asked.T_world_hands
        return asked


class DemoHLMKeyboard(DemoHLMWeb):
    """The page, for its keys."""

    config_class = DemoHLMKeyboardConfig
    name = "demohlm_keyboard"


class DemoHLMGamepad(DemoHLMWeb):
    """The page, for a gamepad."""

    config_class = DemoHLMGamepadConfig
    name = "demohlm_gamepad"


class _Stage:
    """What a page shows of a live world: a session without a recording, which is LeRobot's."""

    def __init__(self, world: live.Operated, config: _PageConfig, clutch: Clutch) -> None:
        self.world, self.task, self.sim, self.clutch = world, world.task, world.sim, clutch
        self.targets = world.seen.view.T_world_hands
        self.paused, self.message = False, HEARD if pynput_can_capture() else ELSEWHERE
        self.server = TeleopServer(
            self, config.host, config.port, lambda line: print(line, flush=True), pace=world.pace, step=self._wait
        )
        self._thread = threading.Thread(target=self._serve, name="page", daemon=True)
        self._thread.start()

    @property
    def state(self) -> str:
        """Engaged or idle."""
        return ENGAGED if any(self.clutch.engaged) else IDLE

    def view(self) -> Any:  # noqa: ANN401
        """Return what an operator sees."""
        return self.world.seen.view

    def __len__(self) -> int:
        """Return the steps since the start."""
        return self.world.seen.step

    def press(self, button: str) -> None:
        """Begin anew at the next start, for ``discard``.

        Raises:
            SessionError: Another button, or LeRobot's episode has begun: two motions would be in it.
        """
        if button != "discard":
            raise SessionError(f"{button!r} while LeRobot records", "discard", "use LeRobot's keys at the terminal")
        if time.monotonic() - self.world.framed_s < EPISODE_OVER_S:
            raise SessionError(
                "'discard' within LeRobot's episode",
                "it between two episodes",
                "wait until the episode has ended; LeRobot's left arrow drops it and records it again",
            )
        self.world.reset()

    def advance(self, controls: Controls) -> None:
        """Do nothing: LeRobot's loop asks for the action."""

    def status(self) -> Status:
        """Return what the operator needs to know now."""
        seen = self.world.seen
        return Status(
            state=self.state,
            paused=False,
            tick=seen.step,
            engaged=self.clutch.engaged,
            grippers=self.clutch.grippers,
            success=seen.success,
            held_s=0.0,
            fallen=False,
            forces={},
            contacts=(),
            warnings=(),
            segments=(),
            verdict=None,
            message=self.message,
            unfinished=0,
        )

    def close(self) -> None:
        """Stop serving."""
        self.server.stop()
        self._thread.join(5.0)

    def _serve(self) -> None:
        try:
            self.server.run()
        except (DemoHLMError, OSError) as error:
            print(json.dumps({"event": "error", "message": str(error)}), flush=True)

    def _wait(self) -> None:
        time.sleep(STEP_DT)
