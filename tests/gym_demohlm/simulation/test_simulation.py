"""Simulation: each world has the same bits alone, in any batch, on any number of threads, and from a snapshot."""

import dataclasses

import mujoco
import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.errors import CommandError, SceneError, UnknownNameError
from gym_demohlm.registry import get_task
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from gym_demohlm.simulation.simulation import MAX_SPEED
from gym_demohlm.task import InitialState
from gym_demohlm.timing import STEP_DT, TICKS
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from tests.helpers.hold import HoldController

TASK = get_task("LiftBox")
# The palms of the home pose press on the box in the last two: contact forces are part of what must repeat.
STATES: list[InitialState] = [
    {"robot": [-0.6, 0.05, 0.2], "object": [0.01, -0.03, 0.5]},
    {"robot": [-0.3, -0.04, -0.1], "object": [0.0, 0.0, -0.4]},
    {"robot": [0.02, 0.0, 0.0], "object": [0.0, 0.25, 0.0]},
    {"robot": [0.05, 0.02, 0.05], "object": [0.02, 0.35, 0.3]},
]


def make(num_worlds: int, num_threads: int = 1) -> Simulation:
    return Simulation(TASK, num_worlds, num_threads, HoldController(num_worlds))


def commands_for(step: int) -> np.ndarray:
    rng = np.random.default_rng(step)
    commands = np.tile(command.rest(), (len(STATES), 1))
    commands[:, command.ARMS] += rng.uniform(-0.4, 0.4, (len(STATES), 14))
    return commands


def run(order: list[int], num_threads: int = 1, steps: int = 6) -> dict[int, list[np.ndarray]]:
    """Return what each world of STATES went through when stepped in this order."""
    sim = make(len(order), num_threads)
    sim.reset([STATES[world] for world in order])
    seen: dict[int, list[np.ndarray]] = {world: [] for world in order}
    for step in range(steps):
        result = sim.step(commands_for(step)[order])
        poses = [sim.pose(name) for name in ("left_palm", "head_camera", "box", "torso")]
        arrays = (sim.qpos, sim.qvel, *poses, result.contact_forces, result.collision_forces, sim.gyro)
        for row, world in enumerate(order):
            seen[world].append(np.concatenate([array[row].ravel() for array in arrays]))
    sim.close()
    return seen


@pytest.fixture(scope="module")
def reference() -> dict[int, list[np.ndarray]]:
    return run([0, 1, 2, 3])


@pytest.mark.parametrize(
    ("order", "num_threads"), [([3], 1), ([2], 1), ([0], 1), ([2, 0, 3, 1], 1), ([3, 2, 1, 0], 2), ([1, 3], 2)]
)
def test_a_world_has_the_same_bits_in_any_company(
    reference: dict[int, list[np.ndarray]], order: list[int], num_threads: int
) -> None:
    again = run(order, num_threads)
    for world in order:
        for step, (first, second) in enumerate(zip(reference[world], again[world], strict=True)):
            np.testing.assert_array_equal(first, second, err_msg=f"world {world}, step {step}")


def test_the_robot_touches_the_box_in_the_worlds_that_test_the_bits() -> None:
    sim = make(len(STATES))
    sim.reset(STATES)
    forces = np.concatenate([sim.step(commands_for(step)).contact_forces for step in range(6)], axis=1)
    assert (forces[2:].max(axis=(1, 2)) > 1.0).any()
    assert (forces >= 0.0).all()


def test_a_restored_snapshot_repeats_bit_for_bit() -> None:
    sim = make(4)
    sim.reset(STATES)
    sim.step(commands_for(0))
    snapshot = sim.snapshot()
    before = {name: values.copy() for name, values in snapshot.items()}
    first = [sim.step(commands_for(step)) for step in (1, 2)]
    later = sim.snapshot()
    sim.step(commands_for(9))
    sim.restore(snapshot)
    for name, values in sim.snapshot().items():
        np.testing.assert_array_equal(values, before[name], err_msg=name)
    second = [sim.step(commands_for(step)) for step in (1, 2)]
    for name, values in sim.snapshot().items():
        np.testing.assert_array_equal(values, later[name], err_msg=name)
    for one, two in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.contact_forces, two.contact_forces)


def test_a_snapshot_moves_to_another_simulation_and_place() -> None:
    many, one = make(4), make(1)
    many.reset(STATES)
    many.step(commands_for(0))
    one.restore(many.snapshot(np.array([3])))
    many.step(commands_for(1))
    one.step(commands_for(1)[3:])
    np.testing.assert_array_equal(one.qpos[0], many.qpos[3])
    np.testing.assert_array_equal(one.start_pose("box")[0], many.start_pose("box")[3])


def test_the_snapshot_of_another_batch_is_refused() -> None:
    with pytest.raises(SceneError, match="snapshot"):
        make(1).restore(make(2).snapshot())


def test_worlds_left_out_stay_as_they_are() -> None:
    sim, whole = make(4), make(4)
    for each in (sim, whole):
        each.reset(STATES)
    before = sim.snapshot()
    active = np.array([True, False, True, False])
    commands = commands_for(0)
    whole.step(commands)
    commands[~active] = np.nan  # nobody looks at them
    result = sim.step(commands, active)
    after, moved = sim.snapshot(), whole.snapshot()
    for name in before:
        np.testing.assert_array_equal(after[name][~active], before[name][~active], err_msg=name)
        np.testing.assert_array_equal(after[name][active], moved[name][active], err_msg=name)
    assert (result.commands[~active] == 0.0).all()


def test_a_reset_world_forgets_what_was_before() -> None:
    used, fresh = make(4), make(4)
    used.reset(STATES[::-1])
    used.step(commands_for(3))
    used.reset([STATES[1], STATES[3]], np.array([1, 3]))
    fresh.reset(STATES)
    for each in (used, fresh):
        each.step(commands_for(0))
    for name, values in used.snapshot().items():
        np.testing.assert_array_equal(values[[1, 3]], fresh.snapshot()[name][[1, 3]], err_msg=name)


def test_broken_physics_is_reported_and_the_others_go_on(tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(str(tmp_path))  # MuJoCo writes a log file about it
    sim, sane = make(4), make(4)
    for each in (sim, sane):
        each.reset(STATES)
    too_fast = [[1e11, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 2 * MAX_SPEED]]  # MuJoCo's own check stops at 1e10 m/s
    sim.set_velocity("pelvis", np.array(too_fast), np.array([1, 2]))
    result = sim.step(commands_for(0))
    sane_result = sane.step(commands_for(0))
    assert result.unstable.tolist() == [False, True, True, False]
    assert not sane_result.unstable.any()
    for row in (0, 3):
        np.testing.assert_array_equal(sim.qpos[row], sane.qpos[row])
        np.testing.assert_array_equal(result.contact_forces[row], sane_result.contact_forces[row])
    assert np.isfinite(sim.qpos).all()
    time = sim.time
    sim.step(commands_for(1))
    assert sim.time[1] == time[1] and sim.time[0] > time[0]
    sim.reset([STATES[1]], np.array([1]))
    assert not sim.unstable[1]


def test_time_and_commands() -> None:
    sim = make(1)
    sim.reset([STATES[0]])
    wild = command.rest()[None].copy()
    wild[0, 0], wild[0, 3] = 9.0, -1.0
    result = sim.step(wild)
    assert result.num_clipped.tolist() == [2]
    assert result.commands[0, 0] == command.UPPER[0] and result.commands[0, 3] == command.LOWER[3]
    np.testing.assert_array_equal(sim.command, result.commands)
    np.testing.assert_allclose(sim.time, STEP_DT, atol=1e-12)


def test_what_is_handed_out_is_a_copy() -> None:
    sim = make(2)
    names = ("qpos", "qvel", "time", "command", "unstable", "joint_positions", "gyro", "base_quat_wxyz",
             "collision_force", "neck_positions")  # fmt: skip
    for read in (*(lambda name=name: getattr(sim, name) for name in names), lambda: sim.pose("box"),
                 lambda: sim.start_pose("box"), lambda: sim.contact_force("left", "box"),
                 *(lambda name=name: sim.snapshot()[name] for name in sim.snapshot())):  # fmt: skip
        before = read().copy()
        read()[...] = 7
        np.testing.assert_array_equal(read(), before)


def test_poses_are_those_of_mujoco() -> None:
    sim = make(2)
    sim.reset(STATES[:2])
    sim.step(commands_for(0)[:2])
    model, data = sim.model, mujoco.MjData(sim.model)
    data.qpos[:] = sim.qpos[1]
    mujoco.mj_kinematics(model, data)
    np.testing.assert_array_equal(sim.pose("torso")[1, :3, 3], data.body("torso_link").xpos)
    np.testing.assert_array_equal(sim.pose("left_palm")[1, :3, :3].ravel(), data.site("left_palm").xmat)
    offset = data.body("pelvis").xpos - data.body("box").xpos
    np.testing.assert_allclose(sim.distance("pelvis", "box")[1], np.linalg.norm(offset), rtol=1e-12)


def test_objects_and_supports_start_where_the_state_says() -> None:
    sim = make(1)
    sim.reset([{"robot": [-0.5, 0.1, 0.3], "object": [0.05, -0.12, 0.7]}])
    box, stand = sim.pose("box")[0], sim.pose("stand")[0]
    np.testing.assert_allclose(box[:3, 3], [0.35, 0.05, 0.29 - 0.12], atol=1e-12)
    np.testing.assert_allclose(np.arctan2(box[1, 0], box[0, 0]), 0.7, atol=1e-12)
    np.testing.assert_allclose(stand[:3, 3], [0.35, 0.05, -0.12], atol=1e-12)
    rest = command.rest()[None]
    for _ in range(3):
        sim.step(rest)
    np.testing.assert_allclose(sim.pose("box")[0, :3, 3], box[:3, 3], atol=5e-4)  # it neither falls nor jumps


def test_a_support_that_is_tracked_too_moves_once() -> None:
    """The other table of CarryBox is furniture and an object: it goes where objects go, with its own offset."""
    sim = Simulation(get_task("CarryBox"), controller=HoldController(1))
    sim.reset([{"robot": [-0.5, 0.0, 0.0], "object": [0.05, -0.12, 0.0], "goal": [0.1, 0.2, 0.0]}])
    default = np.array(get_task("CarryBox").object("goal").position)
    np.testing.assert_allclose(sim.pose("goal")[0, :3, 3], default + np.array([0.1, 0.25, -0.12]), atol=1e-12)
    np.testing.assert_allclose(sim.pose("table")[0, 1:3, 3], [0.05, -0.12], atol=1e-12)
    sim.close()


@pytest.mark.parametrize("name", ["LiftBox", "PressCube", "PushCube", "Handover", "GraspCube", "ExchangeCube"])
def test_no_box_lies_parallel_to_the_last_bit(name: str) -> None:
    task = get_task(name)
    sim = Simulation(task, controller=HoldController(1))
    sim.reset([{"robot": [-3.0, 0.0, 0.0], "object": [0.01, -0.02, 0.65]}])  # where it touches nothing
    for _ in range(5):
        sim.step(command.rest()[None])
    box = task.objects[0].name
    leaning = np.abs(sim.pose(box)[0, 2, :2])
    assert np.all((leaning > 1e-9) & (leaning < 1e-4))  # rad: too little to be seen, enough for MuJoCo's collider
    sim.close()


def test_the_neck_turns_the_camera_to_the_box() -> None:
    sim = make(1)
    sim.reset([{"robot": [-0.6, 0.0, 0.5], "object": [0.0, 0.0, 0.0]}])

    def bearing() -> float:
        camera = sim.pose("head_camera")[0]
        towards = sim.pose("box")[0, :3, 3] - camera[:3, 3]
        return float(np.arccos(camera[:3, 0] @ towards / np.linalg.norm(towards)))

    assert bearing() < 0.01  # from the first image on
    sim.restore(sim.snapshot() | {"neck": np.zeros((1, 2))})
    for joint in ("neck_yaw_joint", "neck_pitch_joint"):
        sim.set_joint(joint, 0.0)
    start = bearing()
    for _ in range(10):
        sim.step(command.rest()[None])
    assert start > 0.5 and bearing() < 0.1


def test_arm_targets_go_no_faster_than_arms_may() -> None:
    sim = make(1)
    sim.reset([STATES[0]])
    wanted = command.rest()[None]
    wanted[0, command.ARMS.start] += 1.2  # rad
    wanted[0, command.ARMS.start + 3] += 0.4
    applied = [sim.step(wanted).commands[0] - command.rest() for _ in range(3)]
    assert [row[command.ARMS.start] for row in applied] == pytest.approx([0.5, 1.0, 1.2])
    assert [row[command.ARMS.start + 3] for row in applied] == pytest.approx([0.4, 0.4, 0.4])
    sim.close()


def test_success_and_failure_of_lift_box() -> None:
    sim = make(3)
    sim.reset([STATES[0]] * 3)
    assert not sim.success().any() and not sim.failures()["dropped"].any()
    T_world_box = sim.pose("box")
    T_world_box[:, :3, 3] = sim.pose("pelvis")[:, :3, 3] + [[0.4, 0, 0], [0.7, 0, 0], [0.4, 0, -0.6]]
    sim.set_pose("box", T_world_box)
    assert sim.success().tolist() == [True, False, False]  # held near, lifted but far, near but low
    assert sim.failures()["dropped"].tolist() == [False, False, True]


def test_what_is_set_is_what_is_read() -> None:
    sim = make(3)
    sim.reset(STATES[:3])
    before, some = sim.snapshot(), np.array([2, 0])
    T = np.stack([poses.pose([1.0, 2.0, 3.0]) @ poses.planar(0.0, 0.0, 0.5), poses.planar(-1.0, 0.0, -2.0)])
    speed = np.arange(12.0).reshape(2, 6)
    for name in ("pelvis", "box"):
        sim.set_pose(name, T, some)
        sim.set_velocity(name, speed, some)
        np.testing.assert_allclose(sim.pose(name)[some], T, atol=1e-12)
        np.testing.assert_array_equal(sim.velocity(name)[some], speed)
    sim.set_pose("stand", T[0])  # a mocap body, in all worlds
    np.testing.assert_allclose(sim.pose("stand"), np.stack([T[0]] * 3), atol=1e-12)
    sim.set_joint("left_knee_joint", np.array([0.3, 0.4]), 2.0, some)
    knee = g1.BODY_JOINTS.index("left_knee")
    for positions in (sim.joint_position("left_knee_joint"), sim.joint_positions[:, knee]):
        assert positions[some].tolist() == [0.3, 0.4]
    assert sim.joint_velocity("left_knee_joint")[some].tolist() == [2.0, 2.0]
    after = sim.snapshot()
    for name in set(before) - {"mocap"}:
        np.testing.assert_array_equal(after[name][1], before[name][1], err_msg=name)
    np.testing.assert_array_equal(after["physics"][:, 0], before["physics"][:, 0])  # the time


def test_what_cannot_be_set_is_explained() -> None:
    sim = make(1)
    for name in ("torso", "left_palm"):  # a body with a hinge, a site
        with pytest.raises(SceneError, match="no free joint"):
            sim.set_pose(name, np.eye(4))
        with pytest.raises(SceneError, match="no free joint"):
            sim.set_velocity(name, np.zeros(6))
    with pytest.raises(UnknownNameError, match="left_knee_joint"):
        sim.set_joint("left_kne_joint", 0.0)
    with pytest.raises(UnknownNameError, match="floating_base_joint"):
        sim.set_joint("floating_base_joint", 0.0)


def test_the_hook_is_called_after_each_tick_with_the_worlds_that_took_part() -> None:
    sim, plain = make(3), make(3)
    seen: list[tuple[list[int], float]] = []
    for each in (sim, plain):
        each.reset(STATES[:3])
    sim.on_tick = lambda worlds, commands: seen.append((worlds.tolist(), commands[0, command.ARMS.start]))
    active = np.array([True, False, True])
    for each in (sim, plain):
        each.step(commands_for(0)[:3], active)
    assert [worlds for worlds, _ in seen] == [[0, 2]] * TICKS
    arm = [value for _, value in seen]
    assert arm == sorted(arm, reverse=arm[0] > arm[-1]) and len(set(arm)) == TICKS  # interpolated over the step
    for name, values in sim.snapshot().items():
        np.testing.assert_array_equal(values, plain.snapshot()[name], err_msg=name)


def test_the_fields_of_a_snapshot_are_those_of_demonstrations_on_disk() -> None:
    demonstration = demonstrations.load(None, TASK)
    assert set(make(1).snapshot()) == set(demonstration.start) == set(demonstration.end)


def test_bad_input_is_explained() -> None:
    sim = make(2)
    with pytest.raises(CommandError, match=r"\(2, 23\)"):
        sim.step(np.zeros((1, 23)))
    bad = np.tile(command.rest(), (2, 1))
    bad[1, 4] = np.nan
    with pytest.raises(CommandError, match=r"torso_roll\.pos"):
        sim.step(bad)
    with pytest.raises(UnknownNameError, match="left_palm"):
        sim.pose("left_plam")
    with pytest.raises(UnknownNameError, match="contact pair"):
        sim.contact_force("left", "stand")
    with pytest.raises(SceneError, match="initial state"):
        sim.reset([{"robot": [0.0, 0.0]}] * 2)  # pyright: ignore[reportArgumentType]
    with pytest.raises(SceneError, match="initial states"):
        sim.reset([STATES[0]])
    with pytest.raises(SceneError, match="num_worlds=0"):
        make(0)
    for count in (1, 3):
        with pytest.raises(SceneError, match=f"a controller for {count} worlds; expected one for 2"):
            Simulation(TASK, 2, controller=HoldController(count))


def test_an_object_that_cannot_be_placed_is_refused() -> None:
    lost = dataclasses.replace(TASK.objects[0], name="crate")
    task = dataclasses.replace(TASK, objects=(lost,), gaze_target="crate", contact_pairs=())
    with pytest.raises(UnknownNameError, match="crate"):
        Simulation(task, controller=HoldController(1))
