"""Observations: symmetric poses, frames, one observation for one state."""

import math

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.envs.observation import (
    OBJECT_SIZE,
    STATE_FEATURES,
    STATE_NAMES,
    agent_pos,
    environment_features,
    environment_state,
    nearest_equivalent,
)
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import ObjectSpec
from tests.helpers.hold import HoldController

QUARTERS = (0.0, math.pi / 2, math.pi, -math.pi / 2)


def spec(symmetry: object) -> ObjectSpec:
    return ObjectSpec(name="thing", position=(0, 0, 0), symmetry=symmetry)  # pyright: ignore[reportArgumentType]


def simulation(num_worlds: int = 1) -> Simulation:
    return Simulation(get_task("LiftBox"), num_worlds, controller=HoldController(num_worlds))


def tilted(yaw: np.ndarray, roll: float = 0.0, pitch: float = 0.0) -> np.ndarray:
    return poses.planar(0.3, -0.2, yaw) @ poses.from_rotation(poses.rotation_from_rpy([roll, pitch, 0.0]), [0, 0, 0.4])


def test_a_square_box_looks_the_same_after_a_quarter_turn() -> None:
    rng = np.random.default_rng(0)
    yaw = rng.uniform(-np.pi, np.pi, 50)
    camera = tilted(rng.uniform(-np.pi, np.pi, 50), pitch=0.7)
    first = nearest_equivalent(tilted(yaw, 0.1), spec(QUARTERS), camera)
    for turn in QUARTERS:
        turned = tilted(yaw, 0.1) @ poses.planar(0.0, 0.0, turn)
        np.testing.assert_allclose(nearest_equivalent(turned, spec(QUARTERS), camera), first, atol=1e-12)
    upright = nearest_equivalent(tilted(yaw), spec(QUARTERS), camera)
    assert (np.abs(poses.wrap_angle(poses.yaw(upright) - poses.yaw(camera))) <= np.pi / 4 + 1e-9).all()


def test_a_round_thing_faces_as_the_camera_does() -> None:
    yaw = np.linspace(-3, 3, 7)
    camera = tilted(np.linspace(-1, 1, 7), pitch=1.2)
    T = nearest_equivalent(tilted(yaw), spec("any"), camera)
    np.testing.assert_allclose(poses.yaw(T), poses.yaw(camera), atol=1e-12)
    np.testing.assert_allclose(T[:, :3, 2], tilted(yaw)[:, :3, 2], atol=1e-12)


def test_a_thing_without_symmetry_stays() -> None:
    T = tilted(np.array([0.3, 2.0]))
    np.testing.assert_array_equal(nearest_equivalent(T, spec((0.0,)), tilted(np.array([0.0, 0.0]))), T)


def test_the_box_in_the_camera_frame() -> None:
    sim = simulation()
    sim.reset([{"robot": [-0.5, 0.1, 0.2], "object": [0.02, -0.05, 0.1]}])
    seen = environment_state(sim)[0].astype(np.float64)
    R_camera_box = np.stack([seen[3:6], seen[6:9], np.cross(seen[3:6], seen[6:9])], axis=1)
    T_world_box = sim.pose("head_camera")[0] @ poses.from_rotation(R_camera_box, seen[:3])
    np.testing.assert_allclose(T_world_box[:3, 3], sim.pose("box")[0, :3, 3], atol=1e-6)
    np.testing.assert_allclose(T_world_box[:3, :3], sim.pose("box")[0, :3, :3], atol=1e-6)  # 0.1 is nearest to 0.2
    assert seen[0] > 0.5 and np.abs(seen[1:3]).max() < 0.01  # the camera looks at it


def test_the_whole_scene_may_move() -> None:
    """A planar motion of robot and box together changes nothing that is observed, up to a quarter turn of the box."""
    sim = simulation(2)
    sim.reset([{"robot": [-0.5, 0.0, 0.3], "object": [0.0, 0.0, 0.4]}] * 2)
    T_motion = poses.planar(1.0, -2.0, 2.2)
    for name in ("pelvis", "box"):
        sim.set_pose(name, T_motion @ sim.pose(name)[1], np.array([1]))
    np.testing.assert_allclose(*environment_state(sim), atol=1e-6)
    np.testing.assert_allclose(*agent_pos(sim), atol=1e-6)


def test_the_robot_reads_its_joints_by_name() -> None:
    sim = simulation()
    expected = {}
    for index, name in enumerate(("left_elbow", "right_knee", "neck_yaw", "waist_pitch")):
        angle, speed = 0.1 + 0.1 * index, 1.0 + index
        sim.set_joint(f"{name}_joint", angle, speed)
        expected |= {f"{name}.pos": angle, f"{name}.vel": speed}
    seen = dict(zip(STATE_NAMES, agent_pos(sim)[0], strict=True))
    for name, value in expected.items():
        assert seen[name] == pytest.approx(value), name
    assert seen["torso_pitch.pos"] == pytest.approx(0.4)  # the waist leans, the pelvis does not
    assert seen["torso_roll.pos"] == pytest.approx(0.0, abs=1e-7)


def test_the_feature_table() -> None:
    assert len(STATE_FEATURES) == 68
    assert {feature.unit for feature in STATE_FEATURES} == {"rad", "m", "rad/s", "m/s"}
    task = get_task("LiftBox")
    names = [feature.name for feature in environment_features(task)]
    assert len(names) == OBJECT_SIZE
    assert names[:4] == ["box_x.pos", "box_y.pos", "box_z.pos", "box_r11.pos"]
    assert names[-1] == "box_r32.pos"


@pytest.mark.parametrize(("name", "turn"), [("LiftBox", math.pi / 2), ("GraspCube", math.pi)])
def test_a_turn_shows_in_the_widest_region_alone(name: str, turn: float) -> None:
    for region, shows in (("R3", False), ("R4", True)):
        task = get_task(name).at(region)
        sim = Simulation(task, 2, controller=HoldController(2))
        sim.reset([{"robot": [-0.5, 0.0, 0.0], "object": [0.0, 0.0, 0.2 + yaw]} for yaw in (0.0, turn)])
        straight, turned = environment_state(sim)
        assert (np.abs(straight - turned).max() > 0.1) == shows
        sim.close()
