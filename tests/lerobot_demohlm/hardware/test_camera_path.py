"""Where the head camera was: between measurements, before the first and after the last, while somebody waits."""

from pathlib import Path

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.perception.camera import torso_camera
from lerobot_demohlm.hardware import records
from lerobot_demohlm.hardware.camera_path import CameraPath
from lerobot_demohlm.hardware.slots import Slot
from tests.helpers.robot import until

MS = 1_000_000


@pytest.fixture
def slots(tmp_path: Path) -> tuple[Slot, Slot]:
    return records.slot(tmp_path, "state"), records.slot(tmp_path, "servos")


def torso(time_ns: float) -> np.ndarray:
    return poses.planar(0.3e-9 * time_ns, 0.0, 1.2e-9 * time_ns)


def neck(time_ns: float) -> np.ndarray:
    return np.array([-0.8, 0.5]) * 1e-9 * time_ns


def test_it_is_where_robot_and_neck_were_however_often_each_is_measured(slots: tuple[Slot, Slot]) -> None:
    path, (state, servos) = CameraPath(*slots), slots
    assert path.at(0) is None
    for time_ms in range(10, 200):
        if time_ms % 4 == 0:
            state.write(records.record("state", T_odometry_torso=torso(time_ms * MS)), time_ms * MS)
        if time_ms % 20 == 1:
            servos.write(records.record("servos", neck=neck(time_ms * MS)), time_ms * MS)
        path.at(time_ms * MS)
    for time_ns in np.random.default_rng(0).integers(22 * MS, 180 * MS, 50).tolist():
        expected = torso(time_ns) @ torso_camera(neck(time_ns))
        np.testing.assert_allclose(path.at(time_ns), expected, atol=1e-6)
    assert path.at(11 * MS) is None, "nobody has measured the robot by then"
    newest = torso(196 * MS) @ torso_camera(neck(181 * MS))
    np.testing.assert_allclose(path.at(10**12), newest, atol=1e-12)


def test_a_robot_without_servos_looks_ahead(slots: tuple[Slot, Slot]) -> None:
    slots[0].write(records.record("state", T_odometry_torso=torso(MS)), MS)
    np.testing.assert_allclose(CameraPath(*slots).at(MS), torso(MS) @ torso_camera(np.zeros(2)))


def test_it_is_followed_while_somebody_waits_for_a_picture(slots: tuple[Slot, Slot]) -> None:
    with CameraPath(*slots) as path:
        for time_ms in range(0, 100, 10):
            slots[0].write(records.record("state", T_odometry_torso=torso(time_ms**2 * MS)), time_ms * MS)
            until(lambda time_ns=time_ms * MS: [row[0] for row in path._torso][-1:] == [time_ns], timeout_s=10.0)
        found = path.at(50 * MS)
    assert found is not None
    np.testing.assert_allclose(found, torso(2500 * MS) @ torso_camera(np.zeros(2)), atol=1e-9)
