"""Actions of a LeRobot loop -> a robot at the other end of a network, by way of the deployment's controller process.

LeRobot takes the place of the policy alone: filter, watchdogs and controller are those of ``demohlm deploy``. A loop
that falls silent is a policy that does, and the robot holds.
"""

import json
import logging
import time
from dataclasses import dataclass

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.errors import DemoHLMError
from gym_demohlm.task import Task
from lerobot_demohlm.devices.config_g1 import DemoHLMG1Config, DeviceError
from lerobot_demohlm.devices.mirror import Mirror
from lerobot_demohlm.hardware import remote, robot_observation
from lerobot_demohlm.hardware.deployment import ASK_AGAIN_S, Deployment
from lerobot_demohlm.hardware.deployment_settings import DeploymentSettings
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.motion_switcher import refuse_own_controller
from lerobot_demohlm.hardware.records import Mode

BALANCE_S = 3.0  # that it stands before it runs
PATIENCE_S = 30.0
_PAUSE_S = 0.02
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class DdsSeen:
    """The robot at one moment.

    Attributes:
        step: Actions since the episode began.
        state: (68,) float32, ``observation.STATE_NAMES``.
        environment_state: (9k,) float32, the tracked objects.
    """

    step: int
    state: np.ndarray
    environment_state: np.ndarray


class DdsRobot:
    """A robot that stands and obeys.

    It stands once it is connected, and runs from the first action of an episode on. A loop that has been silent for
    too long finds it holding until the next episode. On ``lo`` it is a simulated robot; any other waits for its remote:
    start to stand, A to run. It goes on standing until A is pressed and what it needs is there.

    Args:
        config: Where it is.
        task: The task.

    Attributes:
        mirror: What a teleoperator sees of it.
        stays: See ``live.Operated``.

    Raises:
        DemoHLMError: It was refused; nothing has moved.
        DeviceError: It does not stand or run.
    """

    stays = True

    def __init__(self, config: DemoHLMG1Config, task: Task) -> None:
        self._objects, self._step, self._by_remote = len(task.objects), 0, config.interface != "lo"
        self._told_of_hold = False
        refuse_own_controller(config.interface, config.domain)
        self._deployment = Deployment(
            DeploymentSettings(
                task=task.name,
                interface=config.interface,
                policy=None,
                pose_source=config.pose_source,
                servo_port=config.servo_port,
                domain=config.domain,
                tags=config.tags,
                camera="" if config.camera is None else json.dumps(config.camera),
            )
        )
        try:
            self._allow("start")
            self._stand()
            self.mirror = Mirror(task, self._deployment.read)
        except BaseException:
            self._deployment.close()
            raise

    @property
    def seen(self) -> DdsSeen:
        """The robot now.

        Raises:
            DeviceError: Nothing is known of it yet.
        """
        state, pose, servos = (self._deployment.read(name) for name in ("state", "pose", "servos"))
        if state is None:
            raise DeviceError("no state of the robot", "500 a second", "see `demohlm robot-check`")
        neck_and_jaws, objects = None if servos is None else servos.value, np.zeros(9 * self._objects, np.float32)
        if pose is not None:
            objects = robot_observation.environment_state(pose.value, state.value, neck_and_jaws, self._objects)
        return DdsSeen(
            step=self._step,
            state=robot_observation.agent_pos(state.value, neck_and_jaws),
            environment_state=objects,
        )

    def send(self, wanted: np.ndarray) -> None:
        """Hand an action (23,) to the controller; a warning says once an episode that a robot that holds ignores it.

        At the first action of an episode it waits until the robot runs. One that does not within the time stands on,
        and the next action asks again.

        Raises:
            DeviceError: The robot brakes its motors.
            RobotError: Its controller has ended.
        """
        deployment = self._deployment
        self._check()
        if self._step == 0 and deployment.mode in (Mode.STAND, Mode.HOLD) and not self._runs():
            return
        control = deployment.read("control")
        if control is None or int(control.value["mode"]) == Mode.DAMP:
            raise DeviceError(f"a robot that brakes its motors ({deployment.reason})", "one that runs", "connect again")
        run_ns = int(control.value["since_ns"]) if int(control.value["mode"]) == Mode.RUN else -1
        if run_ns < 0 and not self._told_of_hold:
            _log.warning("the robot holds (%s): it makes no action until the next episode", deployment.reason)
            self._told_of_hold = True
        deployment.write_command(wanted, run_ns, self._step)
        self._step += 1

    def reset(self) -> None:
        """Begin an episode: at its first action a robot that holds runs again."""
        self._step, self._told_of_hold = 0, False
        self.mirror.reset()

    def close(self) -> None:
        """Brake the motors."""
        try:
            self._deployment.close()
        finally:
            self.mirror.close()

    def _check(self) -> None:
        """Warn once of a process that has ended: its watchdog holds the robot.

        Raises:
            RobotError: It is the controller.
        """
        try:
            self._deployment.check()
        except DemoHLMError as error:
            if self._deployment.processes["control"].exitcode is not None:
                raise
            _log.warning("the robot holds from now on: %s", error)
            self._deployment.forget_ended()

    def _stand(self) -> None:
        """Stand up; asks again for as long as something is missing that may still come, such as the servos' answer.

        Raises:
            DeviceError: It brakes on its way or after an e-stop, which only a person may lift; or the time is up.
        """
        deployment, until, next_time, began_ns = self._deployment, time.monotonic() + PATIENCE_S, 0.0, 0
        while not deployment.standing:
            now, since_ns, damped = time.monotonic(), deployment.since_ns, deployment.mode == Mode.DAMP
            began_ns = began_ns or since_ns
            braked = damped and (since_ns != began_ns or deployment.reason.startswith("e-stop"))
            if braked or now > until:
                raise DeviceError(
                    f"a robot that does not stand ({deployment.reason})", "one that does", "see `robot-check`"
                )
            if now > next_time and damped:
                deployment.request(Mode.STAND)
                next_time = now + ASK_AGAIN_S
            time.sleep(_PAUSE_S)
        time.sleep(BALANCE_S)

    def _runs(self) -> bool:
        """Have it run, and return whether it does.

        Raises:
            RobotError: It has braked its motors.
        """
        try:
            self._allow("A")
            self._deployment.write_command(command.rest(), -1, 0)  # of no run: it says that actions will come
            self._deployment.run(PATIENCE_S)
        except (DeviceError, RobotError) as error:
            if self._deployment.mode == Mode.DAMP:
                raise
            _log.warning("the robot stands and does not run yet: %s", error)
            return False
        return True

    def _allow(self, button: str) -> None:
        """Wait for a button of a real robot's remote.

        Raises:
            DeviceError: It is not pressed within the time.
        """
        until = time.monotonic() + PATIENCE_S
        while self._by_remote:
            state = self._deployment.read("state")
            if state is not None and button in remote.pressed(int(state.value["buttons"])):
                return
            if time.monotonic() > until:
                raise DeviceError(f"no {button} on the remote", f"{button} within {PATIENCE_S:g} s", "press it")
            time.sleep(_PAUSE_S)
