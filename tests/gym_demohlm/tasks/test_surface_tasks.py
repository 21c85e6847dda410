"""PressCube, PushCube, EraseBoard: success is earned by contact, a push goes left, wiped ink is gone and stays gone."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.errors import UnknownNameError
from gym_demohlm.scene import build_scene
from gym_demohlm.scene.lettering import write
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from gym_demohlm.tasks import erase_board, press_cube, push_cube
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.segmentation import segment
from lerobot_demohlm.generation import retarget, stages
from tests.helpers.hold import HoldController

AWAY = {"robot": [-3.0, 0.0, 0.0], "object": [0.0, 0.0, 0.0]}  # the robot topples where it is in nobody's way


def simulation(task: Task) -> Simulation:
    sim = Simulation(task, controller=HoldController(1))
    sim.reset([AWAY])
    return sim


def put(sim: Simulation, name: str, T_world_object: np.ndarray, wiped: float = 0.0) -> None:
    """Put a loose object somewhere, with a share of the writing gone where there is one."""
    sim.set_pose(name, T_world_object)
    size = sim.memory.shape[1]
    if size:
        sim.restore(sim.snapshot() | {"memory": (np.arange(size) < wiped * size)[None].astype(np.float64)})


@pytest.mark.parametrize("task", [press_cube.TASK, push_cube.TASK, erase_board.TASK], ids=lambda task: task.name)
def test_the_packaged_demonstration_earns_success(task: Task) -> None:
    demonstration = demonstrations.load(task=task)
    sim = simulation(task)
    states = {"start": demonstration.start, "end": demonstration.end}
    for name, state in states.items():
        sim.restore(state | {"controller": sim.snapshot()["controller"]})  # the stand-in's state has another size
        assert sim.success()[0] == (name == "end")
        assert not any(failed[0] for failed in sim.failures().values())
    sim.close()
    kinds = [(entry.hand, entry.kind) for entry in segment(demonstration, task)]
    assert kinds == [("left", "proprioception"), ("right", "object"), ("right", "proprioception")]


def test_a_hand_that_hovers_does_not_press() -> None:
    sim = simulation(press_cube.TASK)
    T_world_palm = sim.pose("right_palm")[0]
    put(sim, "cube", T_world_palm @ poses.pose([0.0, press_cube.CUBE_EDGE / 2 + 0.005, 0.0]))
    assert sim.distance("right_palm", "cube")[0] < press_cube.PRESS_DISTANCE
    assert not sim.success()[0]
    sim.close()


@pytest.mark.parametrize(
    ("offset", "pushed", "success", "dropped"),
    [
        ((0.0, 0.11, 0.0), 0.11, True, False),
        ((0.0, 0.11, 0.0), 0.07, False, False),
        ((0.0, 0.09, 0.0), 0.09, False, False),
        ((0.11, -0.11, 0.0), 0.0, False, False),
        ((0.0, 0.3, -0.03), 0.3, False, False),
        ((0.0, 0.3, -0.2), 0.3, False, True),
    ],
)
def test_a_push_counts_to_the_left_by_the_palm_and_on_the_table(
    offset: tuple[float, float, float], pushed: float, success: bool, dropped: bool
) -> None:
    sim = simulation(push_cube.TASK)
    put(sim, "cube", sim.pose("cube")[0] + poses.pose(offset) - np.eye(4))
    sim.restore(sim.snapshot() | {"memory": np.array([[pushed, offset[1]]])})
    assert sim.success()[0] == success
    assert sim.failures()["dropped"][0] == dropped
    sim.close()


@pytest.mark.parametrize(("force_n", "step", "counted"), [(4.0, 0.02, 0.02), (0.0, 0.02, 0.0), (30.0, 0.08, 0.0)])
def test_a_palm_pushes_what_it_is_on_and_does_not_strike(force_n: float, step: float, counted: float) -> None:
    start, memory = np.eye(4)[None], push_cube.TASK.memory
    pose = poses.pose((0.0, 0.05 + step, 0.0))[None]
    fake: Any = SimpleNamespace(
        pose=lambda _: pose, start_pose=lambda _: start, contact_force=lambda *_: np.array([force_n])
    )
    assert memory is not None
    np.testing.assert_allclose(memory.update(fake, np.array([[0.04, 0.05]])), [[0.04 + counted, 0.05 + step]])


def test_the_field_moves_with_the_table_and_not_with_the_cubes_yaw() -> None:
    sim = simulation(push_cube.TASK)
    sim.reset([AWAY | {"object": [0.07, -0.15, 1.0]}])
    np.testing.assert_allclose(sim.pose("field")[0, :3, 3], np.add(push_cube.FIELD_POSITION, [0.0, 0.07, -0.15]))
    np.testing.assert_allclose(sim.pose("field")[0, :3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(poses.yaw(sim.pose("cube")[0]), 1.0)
    sim.close()


@pytest.mark.parametrize("x", [-0.15, 0.0, 0.15])  # a push may end that far from where the cube stood
def test_what_is_pushed_far_enough_is_on_the_field_and_what_is_not_is_beside_it(x: float) -> None:
    sim, below = simulation(push_cube.TASK), np.zeros(1, dtype=np.int32)
    sim.reset([AWAY | {"object": [0.07, -0.15, 0.0]}])
    put(sim, "cube", poses.pose([5.0, 0.0, 0.0]))
    for further, expected in ((-0.005, "table"), (0.005, "field")):
        above = np.array([push_cube.CUBE_POSITION[0] + x, 0.07 + push_cube.PUSHED_DISTANCE + further, 2.0])
        mujoco.mj_ray(sim.model, sim.mj_data(), above, np.array([0.0, 0.0, -1.0]), None, 1, -1, below)
        assert sim.model.body(sim.model.geom_bodyid[below[0]]).name == expected
    sim.close()


def test_whichever_way_the_cube_faces_it_is_pushed_onto_the_field() -> None:
    """The face is chosen from which the demonstrated push leads far enough to the left."""
    task, demonstration = push_cube.TASK, demonstrations.load(task=push_cube.TASK)
    segments, index = segment(demonstration, task), [entry.name for entry in task.objects].index("cube")
    way = demonstration.T_world_objects[-1, index, :3, 3] - demonstration.T_world_objects[0, index, :3, 3]
    scene = build_scene(task)
    data, rng = mujoco.MjData(scene.model), np.random.default_rng(0)

    def pose(name: str) -> np.ndarray:
        return poses.from_rotation(data.body(name).xmat.reshape(3, 3), data.body(name).xpos)

    world = SimpleNamespace(pose=pose)
    for _ in range(100):
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = scene.place(task.sample("R3", rng))
        mujoco.mj_kinematics(scene.model, data)
        placement = stages.choose_placement(world, task, demonstration, segments)  # pyright: ignore[reportArgumentType]
        motion = retarget.scene_motion(demonstration.T_world_objects[0, index], pose("cube"), placement.symmetry)
        assert (motion[:3, :3] @ way)[1] > push_cube.PUSHED_DISTANCE + 0.005


def test_only_a_gripped_eraser_erases() -> None:
    """All ink gone and the eraser far to the left, but in nobody's hand."""
    sim = simulation(erase_board.TASK)
    moved = sim.pose("eraser")[0] @ poses.pose([0.0, 0.3, 0.0])
    put(sim, "eraser", moved, wiped=1.0)
    assert sim.memory.mean() == 1.0
    assert not sim.success()[0]
    sim.close()


def test_forces_between_things_are_measured_pair_by_pair() -> None:
    """The eraser stands on the tray with its weight, and does not touch the panel."""
    pairs = (("eraser", "board"), ("eraser", "panel"))
    sim = simulation(dataclasses.replace(erase_board.TASK, force_pairs=pairs))
    for _ in range(3):
        result = sim.step(sim.command)
    assert sim.pair_force("eraser", "board")[0] == pytest.approx(0.1 * 9.81, rel=0.05)
    assert sim.pair_force("eraser", "panel")[0] == 0.0
    assert result.contact_forces.shape == (1, 5, len(erase_board.TASK.contact_pairs))
    with pytest.raises(UnknownNameError, match="eraser, panel"):
        sim.pair_force("eraser", "tray")
    sim.close()


def wiped(
    y: float, z: float, force: float, before: np.ndarray | None = None, turned: np.ndarray | None = None
) -> np.ndarray:
    """Return the pieces of ink that are gone once the eraser has pressed at y, z of the board."""
    memory = erase_board.TASK.memory
    assert memory is not None
    T_world_board = np.eye(4) if turned is None else turned
    T_board_eraser = poses.pose([-erase_board.ERASER_SIZE[0] / 2, y, z])
    frames = {"board": T_world_board[None], "eraser": (T_world_board @ T_board_eraser)[None]}
    sim = SimpleNamespace(pose=frames.__getitem__, pair_force=lambda *_: np.array([force]))
    return memory.update(sim, np.zeros((1, memory.size)) if before is None else before)  # pyright: ignore[reportArgumentType]


def test_ink_goes_where_the_eraser_presses_and_stays_gone() -> None:
    middles = (erase_board.INK_START + erase_board.INK_END) / 2
    y, z = middles.mean(axis=0).tolist()
    assert not wiped(y, z, force=0.5).any()
    gone = wiped(y, z, force=2.0)
    assert 0.1 < gone.mean() < 0.5
    np.testing.assert_array_equal(gone[0] > 0, np.abs(middles[:, 0] - y) < erase_board.ERASER_SIZE[1] / 2)
    assert not wiped(y, z + 0.2, force=2.0).any()
    np.testing.assert_array_equal(wiped(y, z, force=0.0, before=gone), gone)
    everywhere = wiped(y, z, force=2.0, turned=poses.planar(0.7, -1.2, 0.6))
    np.testing.assert_array_equal(everywhere, gone)
    for step in np.arange(middles[:, 0].min(), middles[:, 0].max() + 0.02, 0.02).tolist():
        gone = wiped(step, z, force=2.0, before=gone)
    assert gone.all()


def test_wiped_ink_is_not_drawn() -> None:
    sim = simulation(erase_board.TASK)
    put(sim, "eraser", sim.pose("eraser")[0], wiped=0.5)
    sim.mj_data()
    shown = np.array([sim.model.geom(f"ink_{index}").rgba[3] for index in range(len(erase_board.INK))])
    np.testing.assert_array_equal(shown, 1.0 - sim.memory[0])
    sim.close()


def test_a_word_is_written_in_short_pieces_about_its_middle() -> None:
    pieces = write("HELLO", (0.03, 0.06), pitch=0.05, piece_length=0.02)
    lengths = np.linalg.norm(pieces[:, 2:] - pieces[:, :2], axis=1)
    assert lengths.max() <= 0.02 + 1e-12
    per_letter = {"H": 2 * 0.06 + 0.03, "E": 0.06 + 2.8 * 0.03, "L": 0.09, "O": 0.18}
    assert lengths.sum() == pytest.approx(sum(per_letter[letter] for letter in "HELLO"))
    points = pieces.reshape(-1, 2)
    np.testing.assert_allclose([points.min(axis=0), points.max(axis=0)], [[-0.115, -0.03], [0.115, 0.03]])
    with pytest.raises(UnknownNameError, match="E, H, L, O"):
        write("HELP", (0.03, 0.06), pitch=0.05, piece_length=0.02)
