"""The run-time controller: same bits alone and in a batch, mirror symmetry, the gait clock, bad files."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gym_demohlm.control import arm_load, attitude, command, features, gait_clock, odometry, reference
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.control.whole_body import DEFAULT_WEIGHTS, WholeBodyController
from gym_demohlm.errors import SceneError
from gym_demohlm.robot import g1
from gym_demohlm.wbc.training import quasi_static
from gym_demohlm.wbc.training.mdp import MdpConfig, WholeBodyMdp


def _random_inputs(count: int, seed: int) -> tuple[Proprioception, np.ndarray]:
    """Return what robots sense, and commands (count, 23)."""
    rng = np.random.default_rng(seed)
    quat = rng.normal([1, 0, 0, 0], 0.1, (count, 4))
    commands = rng.uniform(command.LOWER, command.UPPER, (count, command.SIZE))
    sensed = Proprioception(
        quat_wxyz=quat / np.linalg.norm(quat, axis=1, keepdims=True),
        gyro=rng.normal(0, 0.5, (count, 3)),
        q=g1.HOME + rng.normal(0, 0.1, (count, 29)),
        dq=rng.normal(0, 0.5, (count, 29)),
    )
    return sensed, commands


def _run(worlds: list[int], ticks: int = 8, total: int = 21) -> tuple[np.ndarray, np.ndarray]:
    controller = WholeBodyController(len(worlds))
    rows = np.array(worlds)
    controller.reset(np.arange(len(worlds)), _random_inputs(total, 0)[0][rows])
    targets = np.zeros((len(worlds), 29))
    for tick in range(ticks):
        sensed, commands = _random_inputs(total, 1 + tick)
        targets = controller.step(sensed[rows], commands[rows])
    return targets, controller.state


def test_same_bits_alone_and_in_any_batch() -> None:
    together, state = _run(list(range(21)))
    for group in ([0], [5], [20], [3, 17], [20, 19, 0], list(range(20, -1, -1))):
        targets, own_state = _run(group)
        assert np.array_equal(targets, together[group])
        assert np.array_equal(own_state, state[group])


def test_subset_of_worlds_moves_only_itself() -> None:
    controller = WholeBodyController(4)
    sensed, commands = _random_inputs(4, 3)
    controller.reset(np.arange(4), sensed)
    before = controller.state.copy()
    some = np.array([2, 0])
    controller.step(sensed[some], commands[some], some)
    assert np.array_equal(controller.state[[1, 3]], before[[1, 3]])
    assert not np.array_equal(controller.state[some], before[some])


def test_state_restores_a_moment() -> None:
    controller = WholeBodyController(3)
    sensed, commands = _random_inputs(3, 5)
    controller.reset(np.arange(3), sensed)
    saved = controller.state.copy()
    first = controller.step(sensed, commands)
    controller.step(sensed, commands)
    controller.state = saved
    assert np.array_equal(controller.step(sensed, commands), first)


def test_mirrored_robot_gets_mirrored_targets() -> None:
    rng = np.random.default_rng(2)
    observed = rng.normal(size=(16, features.OBSERVATION_SIZE)).astype(np.float32)
    controller = WholeBodyController(16)
    plain = controller._act(observed)
    mirrored = controller._act(features.mirror(observed, features.OBSERVATION_MIRROR))
    np.testing.assert_allclose(features.mirror(mirrored, features.ACTION_MIRROR), plain, atol=1e-4)


def test_mirroring_twice_is_the_identity() -> None:
    rows = np.random.default_rng(4).normal(size=(3, features.OBSERVATION_SIZE))
    twice = features.mirror(features.mirror(rows, features.OBSERVATION_MIRROR), features.OBSERVATION_MIRROR)
    assert np.array_equal(twice, rows)


def test_admissible_postures_keep_the_weight_over_the_soles_and_the_waist_within_its_range() -> None:
    rng = np.random.default_rng(8)
    box = rng.uniform([0.40, -0.4, -0.3, -1.0], [0.76, 0.4, 1.2, 1.0], (4000, 4))
    goal = np.concatenate([np.zeros((len(box), 3)), box], axis=1)
    rest = np.ones(len(box), dtype=bool)
    found = reference.admissible(goal, goal, rest)
    np.testing.assert_allclose(reference.admissible(found, found, rest), found, atol=1e-9)  # nothing is left to change
    assert (found[:, [0, 1, 2, 3, 6]] == goal[:, [0, 1, 2, 3, 6]]).all()
    assert np.abs(found - goal).mean(axis=0)[[4, 5]].max() < 0.01  # rad: few postures are out of reach
    ahead, aside = attitude.lean(*found[:, 4:7].T)
    floor = reference.LEAN_BACK + reference.LEAN_BACK_SLOPE * (found[:, 3] - reference.LEAN_BACK_HEIGHT)
    assert (ahead > floor - 0.05).all()
    assert (np.sin(np.abs(aside)) < 0.85).all()


def test_soles_turn_only_in_steps_and_outside_the_postures_of_a_walk() -> None:
    rest, deep = [g1.PELVIS_HEIGHT, 0.0, 0.2, 0.1], [0.45, 0.0, 0.2, 0.1]
    torso, standing = np.array([rest, rest, deep, [0.575, 0, 0, 0]]), np.array([True, False, True, True])
    scale = reference.action_scale(standing, torso)
    turns = np.array([joint.endswith("hip_yaw") for joint in features.DRIVEN_JOINTS])
    assert (scale[:, ~turns] == features.ACTION_SCALE[~turns]).all()
    shares = scale[:, turns] / features.ACTION_SCALE[turns]
    np.testing.assert_allclose(shares, np.array([[0.0, 1.0, 1.0, 0.5]]).T * np.ones(2), atol=1e-12)


def test_waist_turns_the_torso_to_its_commanded_attitude() -> None:
    rng = np.random.default_rng(6)
    roll, pitch, yaw = rng.uniform([[-0.3], [-0.25], [-0.8]], [[0.3], [0.8], [0.8]], (3, 200))
    forward, right = attitude.lean(roll, pitch, yaw)
    tilt, bank = attitude.pelvis_attitude(forward, right, 0.4 * forward)
    waist_roll, waist_pitch = attitude.waist_angles(roll, pitch, yaw, tilt, bank)
    inside = (np.abs(waist_roll) < 0.499) & (np.abs(waist_pitch) < 0.499)
    assert inside.mean() > 0.7
    found = Rotation.from_euler("YX", np.column_stack([tilt, bank])) * Rotation.from_euler(
        "ZXY", np.column_stack([yaw, waist_roll, waist_pitch])
    )
    up = found.as_matrix()[:, 2]
    np.testing.assert_allclose(np.arctan2(up[:, 1], up[:, 2])[inside], roll[inside], atol=1e-9)
    np.testing.assert_allclose(np.arctan2(-up[:, 0], np.hypot(up[:, 1], up[:, 2]))[inside], pitch[inside], atol=1e-9)


def _leg_model() -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = g1.load_body_spec().compile()
    return model, mujoco.MjData(model)


def test_sole_points_agree_with_the_model() -> None:
    model, data = _leg_model()
    rng = np.random.default_rng(7)
    for _ in range(5):
        data.qpos[:] = 0
        data.qpos[3] = 1
        legs = rng.uniform(-0.5, 0.8, 12)
        for joint, value in zip(g1.LEG_JOINTS, legs, strict=True):
            data.joint(f"{joint}_joint").qpos[:] = value
        mujoco.mj_forward(model, data)
        soles = np.stack([data.site(f"{side}_sole").xpos for side in g1.SIDES])
        np.testing.assert_allclose(odometry.sole_points(legs[None])[0], soles, atol=1e-9)


def test_odometry_finds_the_velocity_over_a_planted_foot() -> None:
    model, data = _leg_model()
    rng = np.random.default_rng(8)
    for _ in range(5):
        yaw = rng.uniform(-3, 3)
        attitude = Rotation.from_euler("ZYX", [yaw, *rng.uniform(-0.3, 0.3, 2)])
        x, y, z, w = attitude.as_quat()
        legs = np.concatenate([[-0.2, 0.05, 0.1, 0.4, -0.2, 0.0], [-0.9, 0.0, 0.0, 1.6, -0.7, 0.0]])  # right foot up
        data.qpos[:], data.qvel[:] = 0, 0
        data.qpos[3:7] = [w, x, y, z]
        data.qvel[6:18], data.qvel[3:6] = rng.normal(0, 1, 12), rng.normal(0, 0.5, 3)
        for joint, value in zip(g1.LEG_JOINTS, legs, strict=True):
            data.joint(f"{joint}_joint").qpos[:] = value
        mujoco.mj_forward(model, data)
        velocity = np.zeros(6)
        site = mujoco.mjtObj.mjOBJ_SITE
        mujoco.mj_objectVelocity(model, data, site, data.site("left_sole").id, velocity, 0)
        expected = Rotation.from_euler("z", -yaw).apply(-velocity[3:])[
            :2
        ]  # the pelvis must move so that the sole rests
        down = attitude.inv().apply([0.0, 0.0, -1.0])
        found, tilt, height, over_soles = odometry.estimate(
            down[None], data.qvel[None, 3:6], legs[None], data.qvel[None, 6:18]
        )
        assert height[0] == pytest.approx(data.qpos[2] - data.site("left_sole").xpos[2], abs=1e-9)
        np.testing.assert_allclose(found[0], expected, atol=1e-3)
        middle = np.mean([data.site(f"{side}_sole").xpos for side in g1.SIDES], axis=0)
        expected = Rotation.from_euler("z", -yaw).apply(data.qpos[:3] - middle)
        np.testing.assert_allclose(over_soles[0], expected[:2], atol=1e-9)
        normal = data.site("left_sole").xmat.reshape(3, 3)[2, 2]
        assert tilt[0] == pytest.approx(np.arccos(normal), abs=1e-6)


def test_reference_puts_the_soles_at_the_commanded_height() -> None:
    table = np.zeros((len(reference.TABLE_HEIGHTS), len(reference.TABLE_PITCHES), 5))
    pose = reference.Reference(table, np.zeros(arm_load.TABLE_SHAPE)).pose
    heights = np.linspace(0.5, 0.74, 7)
    commands = np.zeros((7, 7))
    commands[:, 3] = heights
    targets = pose(commands, gait_clock.at_rest(7), np.zeros((7, 2)), np.zeros((7, 2)))
    hip, knee, ankle = targets[:, 0], targets[:, 3], targets[:, 4]
    reach = g1.THIGH_LENGTH * np.cos(hip) + g1.SHANK_LENGTH * np.cos(hip + knee)
    np.testing.assert_allclose(reach + g1.HIP_DROP + g1.SOLE_DROP, heights, atol=1e-9)
    np.testing.assert_allclose(hip + knee + ankle, 0, atol=1e-12)


def test_load_of_the_waist_is_that_of_the_model() -> None:
    found = quasi_static.torso_load()
    np.testing.assert_allclose(found, (reference.TORSO_LOAD_UP, reference.TORSO_LOAD_AHEAD), rtol=0.01)


def test_aiming_further_by_the_sag_holds_the_height() -> None:
    errors = {}
    for name in ("pose", "targets"):
        mdp = WholeBodyMdp(MdpConfig(num_worlds=16, num_variants=1, seed=3, largest_delay=0))
        mdp.level = 0.3
        if name == "pose":
            mdp.reference.sag = lambda command, *_: np.zeros((len(command), reference.NUM_LOWER))  # type: ignore[method-assign]
        for _ in range(20):
            mdp.step(np.zeros((16, features.ACTION_SIZE)))
        rests = mdp.now.clock.standing
        errors[name] = np.abs(mdp.qpos[rests, 2] - mdp.now.slewed[rests, 3]).mean()
    assert errors["targets"] < 0.006
    assert errors["targets"] < 0.5 * errors["pose"]


@pytest.mark.parametrize("content", [b"", b"not an archive", b"PK\x03\x04broken"])
def test_damaged_weights_are_a_clear_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "weights.npz"
    path.write_bytes(content)
    with pytest.raises(SceneError, match="cannot be read"):
        WholeBodyController(1, path)


def test_weights_of_another_format_are_refused(tmp_path: Path) -> None:
    with np.load(DEFAULT_WEIGHTS) as arrays:
        loaded = dict(arrays)
    text = loaded["metadata"].tobytes().replace(b'"format": 5', b'"format": 9')
    loaded["metadata"] = np.frombuffer(text, dtype=np.uint8)
    path = tmp_path / "weights.npz"
    np.savez(path, allow_pickle=False, **loaded)
    with pytest.raises(SceneError, match="format 9"):
        WholeBodyController(1, path)
