"""Leg kinematics, arm loads and quasi-static references against the compiled model."""

import mujoco
import numpy as np
import pytest

from gym_demohlm.control import arm_load, attitude, features, gait_clock, leg_ik, reference
from gym_demohlm.robot import g1
from gym_demohlm.wbc.training import quasi_static


@pytest.fixture(scope="module")
def tables() -> tuple[np.ndarray, np.ndarray]:
    return quasi_static.tables()


class _Model:
    """The bare robot, posed by joint names."""

    def __init__(self, *loads: float) -> None:
        spec = g1.load_body_spec()
        for side, load in zip(g1.SIDES, loads, strict=False):
            g1.add_load(spec, f"{side}_wrist_yaw_link", load, arm_load.HAND)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._address = [self.model.joint(f"{joint}_joint").qposadr[0] for joint in g1.BODY_JOINTS]

    def pose(self, joints: np.ndarray, tilt: float = 0.0, bank: float = 0.0) -> mujoco.MjData:
        about_y = np.array([np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0])
        about_x = np.array([np.cos(bank / 2), np.sin(bank / 2), 0.0, 0.0])
        self.data.qpos[:3] = 0.0
        mujoco.mju_mulQuat(self.data.qpos[3:7], about_y, about_x)
        self.data.qpos[self._address] = joints
        mujoco.mj_forward(self.model, self.data)
        return self.data


def _random_arms(rng: np.random.Generator) -> np.ndarray:
    left, right = rng.uniform([-1.8, -0.1, -0.8, -0.9], [0.6, 1.2, 0.8, 1.5], (2, 4))
    return np.concatenate([left, right * [1, -1, -1, 1]])


def test_legs_put_level_soles_where_they_are_asked_to() -> None:
    model, rng = _Model(), np.random.default_rng(0)
    for _ in range(50):
        tilt, bank, height = rng.uniform(-0.3, 0.8), rng.uniform(-0.4, 0.4), rng.uniform(0.48, 0.54)
        ankles = np.column_stack(
            [rng.uniform(-0.1, 0.15, 2), g1.HIP_SPREAD * np.array([1, -1]) + rng.uniform(-0.05, 0.05, 2), [-height] * 2]
        )
        sole_yaw = rng.uniform(-0.3, 0.3, (1, 2))
        wanted = leg_ik.Vectors(*ankles.T[:, None])
        legs = leg_ik.solve(wanted, sole_yaw, np.array([tilt]), np.array([bank]))[0]
        data = model.pose(np.concatenate([legs.ravel(), np.zeros(3), g1.HOME[15:]]), tilt, bank)
        for side, ankle, yaw in zip(g1.SIDES, ankles, sole_yaw[0], strict=True):
            sole = data.body(f"{side}_ankle_roll_link").xmat.reshape(3, 3)
            np.testing.assert_allclose(sole[2], [0, 0, 1], atol=1e-6)
            assert np.arctan2(sole[1, 0], sole[0, 0]) == pytest.approx(yaw, abs=1e-6)
            np.testing.assert_allclose(data.body(f"{side}_ankle_pitch_link").xpos, ankle, atol=0.01)


def test_arm_load_is_the_first_moment_of_the_models_arms(tables: tuple[np.ndarray, ...]) -> None:
    load, model, rng = arm_load.ArmLoad(tables[1]), _Model(), np.random.default_rng(0)
    shoulders = [model.model.body(f"{side}_shoulder_pitch_link").id for side in g1.SIDES]

    def moment(arms: np.ndarray) -> np.ndarray:
        joints = g1.HOME.copy()
        joints[15 + features.OBSERVED_ARM_INDEX] = arms
        data = model.pose(joints)
        torso = data.body("torso_link")
        R_torso_world = torso.xmat.reshape(3, 3).T
        masses = model.model.body_subtreemass
        return sum(masses[i] * R_torso_world @ (data.subtree_com[i] - torso.xpos) for i in shoulders)

    at_home = moment(g1.HOME[15:][features.OBSERVED_ARM_INDEX])
    for _ in range(20):
        arms = _random_arms(rng)
        np.testing.assert_allclose(load(arms[None], np.zeros((1, 2)))[0], moment(arms) - at_home, atol=2e-3)  # kg m


def test_arm_load_has_the_same_bits_alone_and_in_a_batch(tables: tuple[np.ndarray, ...]) -> None:
    load, rng = arm_load.ArmLoad(tables[1]), np.random.default_rng(1)
    arms = np.stack([_random_arms(rng) for _ in range(37)])
    carried, down = rng.uniform(0, 2, (37, 2)), np.tile([[0.1, 0.2, -0.97]], (37, 1))
    together = load(arms, carried)
    weighed = load.weigh(carried, arms + 0.05, arms, 0.1 * arms, down, 0.02)
    for row, alone in enumerate(arms):
        one = slice(row, row + 1)
        assert load(alone[None], carried[one])[0].tobytes() == together[row].tobytes()
        found = load.weigh(carried[one], alone[None] + 0.05, alone[None], 0.1 * alone[None], down[one], 0.02)
        assert found[0].tobytes() == weighed[row].tobytes()


def test_servos_weigh_what_the_hands_carry(tables: tuple[np.ndarray, ...]) -> None:
    true = np.array([[1.7, 0.4]])
    load, model, rng = arm_load.ArmLoad(tables[1]), _Model(*true[0]), np.random.default_rng(3)
    told = []
    for _ in range(20):
        joints, arms = g1.HOME.copy(), _random_arms(rng)
        joints[15 + features.OBSERVED_ARM_INDEX] = arms
        joints[12:15] = rng.uniform([-0.5, -0.3, -0.3], [0.5, 0.3, 0.4])
        data = model.pose(joints, *rng.uniform([-0.1, -0.2], [0.6, 0.2]))
        stiffness = np.array([g1.motor(joint).stiffness for joint in features.OBSERVED_ARM_JOINTS])
        dofs = [model.model.joint(f"{joint}_joint").dofadr[0] for joint in features.OBSERVED_ARM_JOINTS]
        targets = arms + data.qfrc_bias[dofs] / stiffness  # what the servos give under the weight
        down_pelvis = -data.body("pelvis").xmat.reshape(3, 3)[2]
        down = attitude.in_torso(down_pelvis[None], joints[None, 12:15])
        np.testing.assert_allclose(down[0], -data.body("torso_link").xmat.reshape(3, 3)[2], atol=1e-9)
        found = np.zeros((1, 2))
        for _ in range(400):
            found = load.weigh(found, targets[None], arms[None], np.zeros((1, 8)), down, 0.02)
        told.append((found - true)[0])
    assert np.median(np.abs(told), axis=0).max() < 0.01  # kg
    assert np.max(told) < 0.01  # an arm that hangs straight down says little, but nothing that is not there


def test_loads_move_the_weight_that_is_counted(tables: tuple[np.ndarray, ...]) -> None:
    load, rng = arm_load.ArmLoad(tables[1]), np.random.default_rng(4)
    empty, full = _Model(), _Model(1.5, 0.5)
    for _ in range(10):
        joints, arms = g1.HOME.copy(), _random_arms(rng)
        joints[15 + features.OBSERVED_ARM_INDEX] = arms
        moments = []
        for model in (empty, full):
            data = model.pose(joints)
            mass = model.model.body_subtreemass[1]
            moments.append(mass * (data.subtree_com[1] - data.body("torso_link").xpos))
        found = load(arms[None], np.array([[1.5, 0.5]])) - load(arms[None], np.zeros((1, 2)))
        np.testing.assert_allclose(found[0], moments[1] - moments[0], atol=0.01)  # kg m


def test_reference_keeps_the_weight_over_the_soles_wherever_torso_and_arms_are(tables: tuple[np.ndarray, ...]) -> None:
    pose, model, rng = reference.Reference(*tables), _Model(), np.random.default_rng(2)
    without = []
    for _ in range(40):
        command = np.zeros((1, 7))
        command[0, 3:] = rng.uniform([0.55, -0.3, 0.0, -0.9], [0.74, 0.3, 1.0, 0.9])
        arms = _random_arms(rng)
        at_rest = gait_clock.at_rest(1), np.zeros((1, 2))
        ahead, right = attitude.lean(*command[:, 4:7].T)
        _, tilt, _ = pose.statics(command[:, 3], ahead)
        (tilt,), (bank,) = attitude.pelvis_attitude(ahead, right, tilt)
        moment = pose.arms_moment(command, arms[None], np.zeros((1, 2)))
        offsets = []
        for counted in (moment, 0 * moment):
            joints = g1.HOME.copy()
            joints[:15] = pose.pose(command, *at_rest, counted)[0]
            joints[15 + features.OBSERVED_ARM_INDEX] = arms
            data = model.pose(joints, tilt, bank)
            ankles = np.mean([data.body(f"{side}_ankle_roll_link").xpos for side in g1.SIDES], axis=0)
            offsets.append(np.hypot(*(data.subtree_com[0] - ankles)[:2] - [quasi_static.SOLE_CENTRE, 0.0]))
        assert offsets[0] < 0.02  # m
        without.append(offsets[1])
    assert np.mean(without) > 0.02  # arms move it that far
