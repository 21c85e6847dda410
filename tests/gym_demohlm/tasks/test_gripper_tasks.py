"""Furniture of the gripper tasks: a cart that rolls and keeps its bar up, a door that swings; success is earned."""

import dataclasses

import mujoco
import numpy as np
import pytest

from gym_demohlm.errors import UnknownNameError
from gym_demohlm.registry import get_task
from gym_demohlm.scene import Scene, build_scene
from gym_demohlm.simulation import Simulation
from gym_demohlm.tasks import grasp_cube, open_cabinet, push_cart
from tests.helpers.hold import HoldController

AWAY = {"robot": [-3.0, 0.0, 0.0], "object": [0.0, 0.0, 0.0]}  # the robot topples where it is in nobody's way


def placed(scene: Scene, state: dict[str, list[float]]) -> mujoco.MjData:
    data = mujoco.MjData(scene.model)
    data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = scene.place(state)
    mujoco.mj_forward(scene.model, data)
    return data


def advance(scene: Scene, data: mujoco.MjData, seconds: float) -> None:
    mujoco.mj_step(scene.model, data, nstep=round(seconds / scene.model.opt.timestep))
    mujoco.mj_kinematics(scene.model, data)  # poses of the state after the last step


def test_the_region_lowers_the_bar_and_not_the_cart() -> None:
    scene = build_scene(push_cart.TASK)
    high, low = placed(scene, AWAY), placed(scene, AWAY | {"object": [0.05, -0.2, 0.3]})
    np.testing.assert_allclose(high.body("bar").xpos, [*_bar_position(0.0, 0.0), push_cart.BAR_HEIGHT], atol=1e-12)
    np.testing.assert_allclose(low.body("bar").xpos, [*_bar_position(0.05, 0.3), push_cart.BAR_HEIGHT - 0.2])
    assert low.body("cart").xpos[2] == 0.0


def _bar_position(dy: float, yaw: float) -> np.ndarray:
    x, y, _ = push_cart.CART_POSITION
    return np.array([x + push_cart.BAR_X * np.cos(yaw), y + dy + push_cart.BAR_X * np.sin(yaw)])


def test_an_unknown_height_joint_is_explained() -> None:
    bar, cart = push_cart.TASK.objects
    task = dataclasses.replace(push_cart.TASK, objects=(bar, dataclasses.replace(cart, height_joint="bar_heigth")))
    with pytest.raises(UnknownNameError, match="did you mean 'bar_height'"):
        build_scene(task).place(AWAY)


def test_the_cart_stands_and_rolls_straight_when_pushed() -> None:
    scene = build_scene(push_cart.TASK)
    data = placed(scene, AWAY)
    advance(scene, data, 1.0)
    stood = data.body("cart").xpos.copy()
    np.testing.assert_allclose(stood, push_cart.CART_POSITION, atol=2e-3)
    data.body("bar").xfrc_applied[:3] = 12.0, 0.0, 0.0
    advance(scene, data, 1.0)
    forward, sideways, up = data.body("cart").xpos - stood
    assert 0.15 < forward < 0.6
    assert abs(sideways) < 0.01 and abs(up) < 2e-3
    assert data.body("cart").xmat[8] > 0.9999  # it does not tip


def test_the_posts_hold_the_bar_where_it_was_set() -> None:
    scene = build_scene(push_cart.TASK)
    data = placed(scene, AWAY | {"object": [0.0, -0.1, 0.0]})
    for load in (-60.0, 60.0):
        data.body("bar").xfrc_applied[2] = load  # more than two hands press with
        advance(scene, data, 1.0)
        assert data.joint("bar_height").qpos[0] == pytest.approx(-0.1, abs=2e-3)


def test_the_door_stays_shut_and_swings_on_its_hinge() -> None:
    scene = build_scene(open_cabinet.TASK)
    data = placed(scene, AWAY)
    shut = data.body("handle").xpos.copy()
    advance(scene, data, 0.5)
    np.testing.assert_allclose(data.body("handle").xpos, shut, atol=1e-4)
    data.body("handle").xfrc_applied[0] = -3.0
    advance(scene, data, 1.0)
    angle = data.joint("door_hinge").qpos[0]
    assert 0.2 < angle < 1.5
    x, y, _ = open_cabinet.CABINET_POSITION
    hinge = np.array([x - open_cabinet.DEPTH / 2, y + open_cabinet.HINGE_Y])
    cosine, sine = np.cos(angle), np.sin(angle)
    turned = np.array([[cosine, -sine], [sine, cosine]]) @ (shut[:2] - hinge)
    np.testing.assert_allclose(data.body("handle").xpos[:2] - hinge, turned, atol=1e-6)


@pytest.mark.parametrize("task", [grasp_cube.TASK, open_cabinet.TASK, push_cart.TASK], ids=lambda task: task.name)
def test_success_is_not_given_for_closing_the_grippers(task: object) -> None:
    assert get_task(task.name) is task  # pyright: ignore[reportAttributeAccessIssue]
    sim = Simulation(task, controller=HoldController(1))  # pyright: ignore[reportArgumentType]
    closed = sim.command
    closed[:, -2:] = 1.0
    for _ in range(6):
        assert not sim.success()[0]
        sim.step(closed)
    assert sim.gripper_positions.min() > 0.04  # closed on nothing
    assert not sim.success()[0]
    sim.close()


@pytest.mark.parametrize(("task", "body"), [(open_cabinet.TASK, "handle"), (push_cart.TASK, "cart")])
def test_success_is_not_given_for_things_moved_without_hands(task: object, body: str) -> None:
    """A door or a cart that moves by itself, with nobody's hand on it, is no success."""
    sim = Simulation(task, controller=HoldController(1))  # pyright: ignore[reportArgumentType]
    before = sim.pose(body)[0, :3, 3]
    joint = "door_hinge" if body == "handle" else "cart"
    sim.set_joint(joint, sim.joint_position(joint) + 0.9)
    assert np.linalg.norm(sim.pose(body)[0, :3, 3] - before) > 0.3
    assert not sim.success()[0]
    sim.close()
