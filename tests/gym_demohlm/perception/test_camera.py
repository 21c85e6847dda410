"""The head camera's geometry: against the simulation, and back and forth."""

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.errors import SceneError
from gym_demohlm.perception import camera
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation


def test_neck_angles_give_the_place_of_the_camera_in_the_simulation() -> None:
    sim = Simulation(get_task("LiftBox"), 1)
    T_torso_camera = poses.invert(sim.pose("torso")) @ sim.pose("head_camera")
    np.testing.assert_allclose(camera.torso_camera(sim.neck_positions), T_torso_camera, atol=1e-9)
    sim.close()


def test_pixels_come_back_from_their_points() -> None:
    intrinsics = camera.head_intrinsics()
    rng = np.random.default_rng(0)
    uv, depth = rng.uniform(0, 400, (50, 2)), rng.uniform(0.3, 2.0, 50)
    np.testing.assert_allclose(intrinsics.project(intrinsics.unproject(uv, depth)), uv, atol=1e-9)


def test_what_is_left_of_the_robot_is_left_in_the_image_and_what_is_low_is_low() -> None:
    left_and_low = poses.transform(camera.T_OPTICAL_CAMERA, np.array([1.0, 0.2, -0.1]))
    u, v = camera.head_intrinsics().project(left_and_low)
    assert u < 319.5 and v > 239.5


def test_a_window_stays_inside_the_image_and_holds_its_pixels() -> None:
    intrinsics = camera.head_intrinsics()
    window = camera.window_around(np.array([[-30.0, 10.0], [90.0, 60.0]]), 20.0, intrinsics)
    assert window is not None
    assert (window.left, window.top) == (0, 0) and window.width == 111 and window.height == 81
    assert camera.window_around(np.array([[-300.0, 0.0], [-200.0, 9.0]]), 20.0, intrinsics) is None


def test_a_camera_without_size_is_an_error() -> None:
    with pytest.raises(SceneError, match="focal length 0"):
        camera.Intrinsics(width=640, height=480, focal=0.0, center_u=0.0, center_v=0.0)
