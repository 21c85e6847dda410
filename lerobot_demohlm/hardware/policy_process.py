"""Newest state and poses -> a policy's command at 10 Hz: a process of its own, whose silence the watchdog notices.

It acts in RUN only, and begins each run with an empty memory. What a policy gives that is no command is not passed on.
"""

import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gym_demohlm.envs import observation
from gym_demohlm.errors import PolicyError
from gym_demohlm.registry import get_task
from gym_demohlm.task import DEFAULT_REGION
from gym_demohlm.timing import STEP_DT
from lerobot_demohlm.evaluation.loaded_policy import LoadedPolicy, act, load_policy, object_in, trained_task
from lerobot_demohlm.hardware import records, robot_observation
from lerobot_demohlm.hardware.records import Mode

_WARM_UP = 3  # times that it acts before anything depends on it: the first is slow


@dataclass(frozen=True, kw_only=True)
class PolicySettings:
    """Which policy, and for what.

    Attributes:
        path: A ``pretrained_model`` directory.
        task: Name of the task.
        folder: Of the slots.
        device: Where it runs.
        region: Whose objects there are.
    """

    path: Path
    task: str
    folder: Path
    device: str = "cpu"
    region: str = DEFAULT_REGION


def check_policy(path: Path, task: str, device: str = "cpu", region: str = DEFAULT_REGION) -> LoadedPolicy:
    """Load a policy that can drive a robot.

    Raises:
        PolicyError: As ``load_policy``, it looks at images, or it was trained for a task of other hands, or, as far as
            its dataset is still there to tell, with objects of other shapes than the region's.
    """
    loaded = load_policy(path, task, device)
    if loaded.needs_images:
        raise PolicyError("a policy that looks at images", "one that sees poses", "train one on state and poses")
    trained_on, hands = trained_task(path, or_scored=True), get_task(task).hands
    if trained_on is not None and get_task(trained_on).hands != hands:
        raise PolicyError(
            f"a policy for {get_task(trained_on).hands} hands ({trained_on})", f"one for {hands} hands ({task})",
            "mount those hands, or choose another --policy",
        )  # fmt: skip
    trained_in = _trained_region(path)
    if trained_in is not None and get_task(task).at(trained_in).form != get_task(task).at(region).form:
        raise PolicyError(
            f"a policy trained in {trained_in} of {task}, where objects have other shapes or fronts",
            f"one for {region}",
            f"deploy it with --region {trained_in}, or choose another --policy",
        )
    return loaded


def _trained_region(path: Path) -> str | None:
    """Return the region of the dataset that a checkpoint was trained on; None where nothing tells it."""
    root = (object_in(path / "train_config.json").get("dataset") or {}).get("root")
    return object_in(Path(root) / "meta" / "demohlm.json").get("region") if root else None


class PolicyProcess:
    """Runs a policy.

    Args:
        settings: Which one.

    Raises:
        PolicyError: See ``check_policy``.
    """

    def __init__(self, settings: PolicySettings) -> None:
        import torch

        torch.set_num_threads(1)
        self._loaded = check_policy(settings.path, settings.task, settings.device, settings.region)
        self._task = get_task(settings.task)
        self._slots = {name: records.slot(settings.folder, name) for name in records.RECORDS}
        self._stop, self._run_ns, self._episode, self._step = False, -1, 0, 0
        sizes = {"agent_pos": len(observation.STATE_NAMES), "environment_state": 9 * len(self._task.objects)}
        for _ in range(_WARM_UP):
            act(
                self._loaded,
                {name: np.zeros((1, size), np.float32) for name, size in sizes.items()},
                self._task.description,
            )

    def run(self) -> None:
        """Act until a signal asks for the end."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: setattr(self, "_stop", True))
        due = time.monotonic()
        while not self._stop:
            began = self._act()
            due = (time.monotonic() if began else due) + STEP_DT
            due = max(due, time.monotonic())
            self._sleep_until(due)

    def _sleep_until(self, due: float) -> None:
        """Sleep, but wake when a run begins."""
        while (ahead := due - time.monotonic()) > 0.0 and not self._stop:
            time.sleep(min(ahead, 0.01))
            control = self._slots["control"].read()
            if control is not None and self._begins(control.value):
                return

    def _begins(self, control: np.void) -> bool:
        return int(control["mode"]) == Mode.RUN and int(control["since_ns"]) != self._run_ns

    def _act(self) -> bool:
        """Act once; returns whether a run has begun with it."""
        control, state, pose = (self._slots[name].read() for name in ("control", "state", "pose"))
        read = self._slots["servos"].read()
        servos = None if read is None else read.value
        if control is None or state is None or pose is None or int(control.value["mode"]) != Mode.RUN:
            if control is None or int(control.value["mode"]) != Mode.RUN:
                self._slots["policy"].write(records.record("policy", episode=self._episode, run_ns=-1))
            return False
        begun = self._begins(control.value)
        if begun:
            self._run_ns, self._step = int(control.value["since_ns"]), 0
            self._episode += 1
            self._loaded.policy.reset()
        began, count = time.perf_counter(), len(self._task.objects)
        seen = {
            "agent_pos": robot_observation.agent_pos(state.value, servos)[None],
            "environment_state": robot_observation.environment_state(pose.value, state.value, servos, count)[None],
        }
        wanted = act(self._loaded, seen, self._task.description)[0].astype(np.float64)
        if np.isfinite(wanted).all():
            objects = np.zeros(9 * records.MAX_OBJECTS, np.float32)
            objects[: seen["environment_state"].shape[1]] = seen["environment_state"][0]
            value = records.record(
                "policy", command=wanted, episode=self._episode, step=self._step, run_ns=self._run_ns,
                state_ns=state.time_ns, pose_ns=pose.time_ns, inference_s=time.perf_counter() - began,
                observed_state=seen["agent_pos"][0],
                observed_objects=objects,
            )  # fmt: skip
            self._slots["policy"].write(value)
        self._step += 1
        return begun
