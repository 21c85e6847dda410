"""The mirror of a robot against the world that the robot is really in."""

import time
from collections.abc import Iterator

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from lerobot_demohlm.devices.mirror import Mirror
from lerobot_demohlm.hardware import records
from lerobot_demohlm.hardware.slots import Reading
from tests.helpers.robot import until


class Told:
    """A simulated robot, and what it tells of itself: nothing of where it is."""

    def __init__(self, task: str, dz: float = 0.0) -> None:
        self.sim = Simulation(get_task(task))
        self.sim.reset([self.sim.task.default_state() | {"object": [0.0, dz, 0.0]}])
        self.hidden: tuple[str, ...] = ()

    def read(self, name: str) -> Reading | None:
        """Return the newest value of a record."""
        value = {"state": self._state, "servos": self._servos, "pose": self._pose}[name]()
        return Reading(value=value, number=1, time_ns=time.monotonic_ns())

    def _state(self) -> np.void:
        # An IMU's heading is from wherever it was switched on.
        turned = poses.planar(0.0, 0.0, 1.0) @ self.sim.pose("pelvis")[0]
        return records.record("state", q=self.sim.joint_positions[0], quat_wxyz=poses.split(turned)[1])

    def _servos(self) -> np.void:
        return records.record("servos", neck=self.sim.neck_positions[0], jaws=self.sim.gripper_positions[0])

    def _pose(self) -> np.void:
        value = np.zeros((), records.RECORDS["pose"])
        T_camera_world = poses.invert(self.sim.pose("head_camera")[0])
        for index, entry in enumerate(self.sim.task.objects):
            value["T_camera_object"][index] = T_camera_world @ self.sim.pose(entry.name)[0]
            value["valid"][index] = entry.name not in self.hidden
        return value[()]  # pyright: ignore[reportReturnType]


@pytest.fixture
def told() -> Iterator[Told]:
    made = Told("LiftBox", dz=0.05)
    yield made
    made.sim.close()


def mirrored(told: Told) -> Mirror:
    """Return a mirror that has looked once and looks no more by itself."""
    mirror = Mirror(told.sim.task, told.read)
    mirror._stop.set()
    mirror._thread.join()
    return mirror


def test_it_stands_as_the_robot_does(told: Told) -> None:
    mirror = mirrored(told)
    for frame in ("pelvis", "left_palm", "right_palm", "head_camera", "box"):
        off = poses.invert(told.sim.pose(frame)[0]) @ mirror.sim.pose(frame)[0]
        assert np.abs(off - np.eye(4)).max() < 0.005, frame
    assert mirror.sim.pose("left_sole")[0, 2, 3] == pytest.approx(0.0, abs=0.002)
    table = told.sim.task.supports[0]
    assert mirror.sim.pose(table)[0] == pytest.approx(told.sim.pose(table)[0], abs=0.005)
    mirror.sim.close()


def test_walking_is_counted_from_the_feet_alone(told: Told) -> None:
    mirror = mirrored(told)
    told.sim.set_pose("box", poses.pose([9.0, 0.0, 0.5]))  # out of the way
    begun = told.sim.pose("pelvis")[0]
    wanted = command.rest()
    for velocity in ([-0.4, 0.0, 0.0], [0.0, 0.2, 0.4], [0.0, 0.0, 0.0]):
        wanted[command.VELOCITY] = velocity
        for _ in range(20):
            told.sim.on_tick = lambda _worlds, _commands: mirror._show()  # 50 times a second, as its thread does
            told.sim.step(wanted[None])
    walked = poses.to_planar(poses.invert(begun) @ told.sim.pose("pelvis")[0])
    far = np.hypot(*walked[:2])
    assert far > 0.5
    counted = poses.to_planar(poses.invert(begun) @ mirror.sim.pose("pelvis")[0])
    assert np.hypot(*(counted - walked)[:2]) < 0.15 * far  # soles roll and slide
    assert counted[2] == pytest.approx(walked[2], abs=0.01)
    assert mirror.sim.pose("pelvis")[0, 2, 3] == pytest.approx(told.sim.pose("pelvis")[0, 2, 3], abs=0.02)
    mirror.sim.close()


def test_an_object_out_of_sight_stays_in_the_world(told: Told) -> None:
    mirror = mirrored(told)
    seen = mirror._look().view.T_world_objects["box"]
    told.hidden = ("box",)
    told.sim.set_pose("box", poses.pose([2.0, 0.0, 0.5]))
    mirror._show()
    assert mirror._look().view.T_world_objects["box"] == pytest.approx(seen)
    mirror.sim.close()


def test_a_handle_is_seen_where_the_eyes_see_it() -> None:
    told = Told("OpenCabinet")
    mirror = mirrored(told)
    found = mirror._look().view.T_world_objects
    for entry in told.sim.task.objects:
        assert found[entry.name] == pytest.approx(told.sim.pose(entry.name)[0], abs=0.005)
    mirror.sim.close()
    told.sim.close()


def test_a_new_episode_begins_where_the_task_has_the_robot(told: Told) -> None:
    mirror = Mirror(told.sim.task, told.read)
    try:
        until(lambda: mirror.seen.step >= 2, 20.0)
        before = mirror.seen
        T = told.sim.pose("pelvis")[0]
        T[0, 3] -= 0.4
        told.sim.set_pose("pelvis", T)
        after = mirror.reset()
        assert after.episode == before.episode + 1 and after.step == 0
        assert after.view.T_world_pelvis == pytest.approx(before.view.T_world_pelvis, abs=0.005)
        gap = told.sim.pose("box")[0, 0, 3] - T[0, 3]
        assert after.view.T_world_objects["box"][0, 3] - after.view.T_world_pelvis[0, 3] == pytest.approx(gap, abs=0.01)
    finally:
        mirror.close()
