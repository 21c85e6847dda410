"""The gaze controller on the kinematics of the neck: a target is centred and stays so, within the joint limits."""

import mujoco
import numpy as np
import pytest

from gym_demohlm.control.gaze import GazeController
from gym_demohlm.robot import neck, robot

DT = 0.02


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return robot.robot_spec("rubber").compile()


def target_in_camera(model: mujoco.MjModel, angles: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Position of a point of the world in the camera frame, pelvis at rest at the origin, (3,) [m]."""
    data = mujoco.MjData(model)
    data.qpos[:3] = 0.0
    for name, angle in zip(neck.NECK_JOINTS, angles, strict=True):
        data.joint(f"{name}_joint").qpos = angle
    mujoco.mj_kinematics(model, data)
    site = data.site("head_camera")
    return site.xmat.reshape(3, 3).T @ (target - site.xpos)


def bearing(p_camera: np.ndarray) -> np.ndarray:
    """Angles of a point off the optical axis, left and up, (2,) [degrees]."""
    x, y, z = p_camera
    return np.degrees([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])


TARGETS = [(0.35, 0.0, -0.45), (0.5, 0.4, -0.2), (1.5, -1.5, 0.0), (2.0, 0.5, 1.0), (0.4, -0.2, -0.5), (0.3, 1.0, 0.2)]


@pytest.mark.parametrize("target", TARGETS)
def test_targets_in_front_are_centred_and_stay_in_the_image(model: mujoco.MjModel, target: tuple[float, ...]) -> None:
    gaze, angles = GazeController(), np.zeros((1, 2))
    seen = False
    for _ in range(250):
        p_camera = target_in_camera(model, angles[0], np.array(target))
        offset = np.abs(bearing(p_camera))
        inside = offset[0] < neck.CAMERA_FOVX / 2 and offset[1] < neck.CAMERA_FOVY / 2
        assert inside or not seen, "a target once in the image left it"
        seen = seen or inside
        angles = gaze.step(angles, p_camera[None], DT)
    assert np.abs(bearing(target_in_camera(model, angles[0], np.array(target)))).max() < 1.0


def test_a_moving_target_is_followed(model: mujoco.MjModel) -> None:
    """At arm's length and 0.3 m/s the target stays within ten degrees of the middle."""
    gaze, angles = GazeController(), np.array([[0.0, 0.4]])
    for tick in range(300):
        target = np.array([0.6, 0.3 * np.sin(0.02 * tick), 0.1])
        p_camera = target_in_camera(model, angles[0], target)
        if tick > 50:
            assert np.abs(bearing(p_camera)).max() < 10.0
        angles = gaze.step(angles, p_camera[None], DT)


def test_limits_and_speed_hold_for_any_target() -> None:
    gaze, rng = GazeController(), np.random.default_rng(0)
    angles = rng.uniform(neck.NECK_LOWER, neck.NECK_UPPER, (64, 2))
    for _ in range(100):
        new = gaze.step(angles, rng.normal(size=(64, 3)), DT)
        assert (new >= neck.NECK_LOWER).all() and (new <= neck.NECK_UPPER).all()
        assert np.abs(new - angles).max() <= gaze.max_speed * DT + 1e-12
        angles = new


def test_each_world_is_alone() -> None:
    gaze, rng = GazeController(), np.random.default_rng(1)
    angles, targets = rng.normal(size=(16, 2)) * 0.3, rng.normal(size=(16, 3))
    together = gaze.step(angles, targets, DT)
    for index in range(16):
        alone = gaze.step(angles[index : index + 1], targets[index : index + 1], DT)
        np.testing.assert_array_equal(alone[0], together[index])


def test_sides_and_heights_have_the_documented_signs() -> None:
    left, above = np.array([[1.0, 0.2, 0.0]]), np.array([[1.0, 0.0, 0.2]])
    still = np.zeros((1, 2))
    assert GazeController().step(still, left, DT)[0, 0] > 0
    assert GazeController().step(still, above, DT)[0, 1] < 0
