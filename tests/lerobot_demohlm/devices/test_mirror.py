"""The mirror of a robot against the world that the robot is really in."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.robot import g1
from lerobot_demohlm.devices import live
from lerobot_demohlm.devices.config_operators import DemoHLMWebConfig
from lerobot_demohlm.devices.mirror import Mirror
from lerobot_demohlm.devices.operators import DemoHLMWeb
from lerobot_demohlm.teleop.clutch import Controls
from tests.helpers.robot import Told, until


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


def test_a_new_episode_sends_a_real_robot_nowhere(told: Told, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A person has it squat with a closed hand; the next episode begins from there, not from a robot at rest."""
    operator = DemoHLMWeb(DemoHLMWebConfig(port=0, calibration_dir=tmp_path))
    monkeypatch.setattr(operator, "_enter", lambda world: None)  # no page, and nobody at it
    monkeypatch.setattr(operator, "_ask", lambda seen: operator._clutch.poses(Controls(), seen.view))
    mirror = mirrored(told)
    live.set_current(mirror)
    try:
        operator.connect()
        operator.get_action()
        squat = command.rest()
        squat[command.HEIGHT] = g1.PELVIS_HEIGHT - 0.15
        squat[command.NAMES.index("left_elbow.pos")] += 0.5
        for _ in range(15):
            told.sim.step(squat[None])
        operator._last = squat.copy()
        operator._last[command.VELOCITY] = 0.3
        operator._clutch.reset(grippers=np.array([1.0, 0.0]))
        mirror.reset()
        action = np.array(list(operator.get_action().values()))
        assert not action[command.VELOCITY].any()
        assert operator._clutch.grippers == (1.0, 0.0)
        assert action[command.HEIGHT] == pytest.approx(squat[command.HEIGHT], abs=0.05)
        assert np.abs(action - squat)[command.ARMS].max() < 0.3
    finally:
        live.set_current(None)
        operator.disconnect()
        mirror.sim.close()
