"""The whole-body inverse kinematics on a robot that obeys commands exactly: it reaches, stays in bounds, forgets."""

import math

import mujoco
import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command, reference
from gym_demohlm.control.ik import IKSettings, IKSolution, WholeBodyIK
from gym_demohlm.control.whole_body import Weights
from gym_demohlm.errors import CommandError
from gym_demohlm.robot import g1, robot

WAIST = slice(len(g1.LEG_JOINTS), len(g1.LEG_JOINTS) + len(g1.WAIST_JOINTS))
PELVIS_SHARE = 0.4  # of the torso's pitch is the pelvis's, the rest the waist's
DT = 0.1


def turn(axis: int, angle: float) -> np.ndarray:
    """Rotation matrix about axis 0, 1 or 2."""
    quat_wxyz, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(quat_wxyz, np.eye(3)[axis], angle)
    mujoco.mju_quat2Mat(matrix, quat_wxyz)
    return matrix.reshape(3, 3)


REST = (g1.PELVIS_HEIGHT, 0.0)  # height, pitch


class ObedientRobot:
    """A robot that stands at a place and is, at once, where its command says."""

    def __init__(self, x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> None:
        self.model = robot.robot_spec("rubber").compile()
        self.data = mujoco.MjData(self.model)
        self.place, self.yaw = np.array([x, y]), yaw
        self.reference = Weights().make_reference()
        self.command = command.rest()

    def measure(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the pelvis pose (4, 4) and the joint positions (29,) that fulfil the command."""
        height, roll, pitch, yaw = self.command[command.TORSO]
        T = np.eye(4)
        T[:3, :3] = turn(2, self.yaw) @ turn(1, PELVIS_SHARE * pitch)
        back = self.reference.pelvis_ahead(height, pitch)[0] - self.reference.pelvis_ahead(*REST)[0]
        T[:3, 3] = [*(self.place + back * turn(2, self.yaw)[:2, 0]), height]
        R_pelvis_torso = T[:3, :3].T @ turn(2, self.yaw + yaw) @ turn(1, pitch) @ turn(0, roll)
        q = g1.HOME.copy()
        q[WAIST] = [  # of R = Rz(yaw) Rx(roll) Ry(pitch), the order of the waist's joints
            np.arctan2(-R_pelvis_torso[0, 1], R_pelvis_torso[1, 1]),
            np.arcsin(R_pelvis_torso[2, 1]),
            np.arctan2(-R_pelvis_torso[2, 0], R_pelvis_torso[2, 2]),
        ]
        stiffness = np.array([g1.motor(joint).stiffness for joint in g1.ARM_JOINTS])
        held = self.command[command.ARMS]
        q[WAIST.stop :] = held
        for _ in range(5):  # the arms sag as those of PD servos do: stiffness times sag is the torque of gravity
            q[WAIST.stop :] = held - self.gravity(T, q) / stiffness
        return T, q

    def gravity(self, T_world_pelvis: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the torques (14,) that hold the arms in a posture."""
        self.put(T_world_pelvis, q)
        mujoco.mj_forward(self.model, self.data)
        return np.array([self.data.joint(f"{joint}_joint").qfrc_bias[0] for joint in g1.ARM_JOINTS])

    def put(self, T_world_pelvis: np.ndarray, q: np.ndarray) -> None:
        self.data.qpos[:3] = T_world_pelvis[:3, 3]
        mujoco.mju_mat2Quat(self.data.qpos[3:7], T_world_pelvis[:3, :3].reshape(9))
        for joint, angle in zip(g1.BODY_JOINTS, q, strict=True):
            self.data.joint(f"{joint}_joint").qpos = angle

    def palms(self) -> list[np.ndarray]:
        """Return the poses of both palms, by MuJoCo."""
        self.put(*self.measure())
        mujoco.mj_kinematics(self.model, self.data)
        return [pose_of(self.data.site(f"{side}_palm")) for side in g1.SIDES]

    def follow(self, ik: WholeBodyIK, targets: list[np.ndarray | None], calls: int) -> IKSolution:
        for _ in range(calls):
            solution = call(ik, self, targets)
            self.command = solution.command
        return solution


def pose_of(view: mujoco._structs._MjDataSiteViews) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = view.xmat.reshape(3, 3), view.xpos
    return T


def call(ik: WholeBodyIK, who: ObedientRobot, targets: list[np.ndarray | None]) -> IKSolution:
    T, q = who.measure()
    return ik.solve(
        T_world_pelvis=T,
        joint_positions=q,
        T_world_left=targets[0],
        T_world_right=targets[1],
        previous=who.command,
        dt=DT,
    )


def around(x: float, z: float, half: float = 0.13, tilt: float | None = None) -> list[np.ndarray]:
    """Targets on both sides of a point ahead of a robot at the origin, finger tips down by `tilt` [rad]."""
    tilt = float(np.clip(1.2 - z, 0.0, 0.9)) if tilt is None else tilt
    targets = [np.eye(4), np.eye(4)]
    for target, sign in zip(targets, (1, -1), strict=True):
        target[:3, :3], target[:3, 3] = turn(1, tilt), [x, sign * half, z]
    return targets


@pytest.fixture(scope="module")
def ik() -> WholeBodyIK:
    return WholeBodyIK(robot.robot_spec("rubber").compile())


def test_arms_come_to_rest_where_a_wrist_cannot_turn_far_enough(ik: WholeBodyIK) -> None:
    """A left palm held upwards low beside the body, as measured: less damped, its elbow swings by 0.4 rad a call."""
    legs = [-0.86, -0.148, -0.187, 1.314, -0.536, -0.092, -0.895, 0.179, 0.208, 1.309, -0.489, 0.073]
    waist, left_arm = [-0.035, 0.006, 0.257], [-0.962, 0.297, 0.936, 1.222, -0.968, 0.316, -0.598]
    right_arm = [-0.937, -0.113, -0.137, -0.45, 0.148, 1.265, -0.155]
    commands = [np.array([0.0, 0.0, 0.0, 0.653, -0.007, 0.346, -0.034, *left_arm, *right_arm, 0.0, 0.0])]
    for _ in range(14):
        solution = ik.solve(
            T_world_pelvis=poses.from_rotation(
                poses.rotation_from_rpy([0.011, 0.084, -0.011]), [-0.126, -0.003, 0.649]
            ),
            joint_positions=np.array(legs + waist + left_arm + right_arm),
            T_world_left=poses.from_rotation(turn(0, 0.03 - np.pi / 2), [0.343, 0.22, 0.707]),
            T_world_right=None,
            previous=commands[-1],
        )
        commands.append(solution.command)
    assert np.abs(np.diff(commands[-5:], axis=0)).max() < 0.01  # rad, m


@pytest.mark.parametrize("z", [0.29, 0.4, 0.6, 0.8, 1.0])
@pytest.mark.parametrize("x", [0.25, 0.35, 0.45])
def test_targets_in_reach_are_reached(ik: WholeBodyIK, x: float, z: float) -> None:
    """To 5 mm and 3 degrees, within a second, plus the time that a low target's bending takes at its rate."""
    who, targets = ObedientRobot(), around(x, z)
    solution = who.follow(ik, targets, 10 if z > 0.5 else 16)
    for palm, target in zip(who.palms(), targets, strict=True):
        assert np.linalg.norm(palm[:3, 3] - target[:3, 3]) < 0.005
        assert np.trace(palm[:3, :3].T @ target[:3, :3]) > 1 + 2 * np.cos(np.radians(3))
    assert solution.position_error.max() < 0.005 and solution.planned_position_error.max() < 0.015


def test_place_and_heading_of_the_robot_do_not_matter(ik: WholeBodyIK) -> None:
    """Moving robot and targets by one planar motion leaves the command as it was."""
    here, there = ObedientRobot(), ObedientRobot(1.0, -2.0, 2.5)
    move = np.eye(4)
    move[:3, :3], move[:2, 3] = turn(2, 2.5), [1.0, -2.0]
    targets = around(0.35, 0.5)
    here.follow(ik, targets, 8)
    there.follow(ik, [move @ target for target in targets], 8)
    np.testing.assert_allclose(here.command, there.command, atol=1e-6)


def test_mirrored_targets_give_mirrored_commands(ik: WholeBodyIK) -> None:
    first, second = ObedientRobot(), ObedientRobot()
    left, right = around(0.35, 0.6)
    right[2, 3] += 0.1
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    first.follow(ik, [left, right], 10)
    second.follow(ik, [mirror @ right @ mirror, mirror @ left @ mirror], 10)
    # Unitree's left and right arms differ by 1e-5 m and rad.
    np.testing.assert_allclose(first.command[[3, 5]], second.command[[3, 5]], atol=2e-3)
    np.testing.assert_allclose(first.command[[4, 6]], -second.command[[4, 6]], atol=2e-3)
    signs = np.array([1, -1, -1, 1, -1, 1, -1])
    np.testing.assert_allclose(first.command[command.LEFT_ARM], signs * second.command[command.RIGHT_ARM], atol=0.02)


def test_low_hands_bend_and_lower_the_torso_bit_by_bit(ik: WholeBodyIK) -> None:
    """The lower the hands, the lower and the more bent the torso; at chest height it stands upright."""
    heights, pitches = [], []
    for z in (0.9, 0.75, 0.6, 0.45, 0.3):
        who = ObedientRobot()
        who.follow(ik, around(0.35, z), 25)
        heights.append(who.command[command.HEIGHT])
        pitches.append(who.command[command.PITCH])
    assert (np.diff(heights) <= 1e-6).all() and (np.diff(pitches) > 0.0).all()
    assert heights[0] > 0.72 and abs(pitches[0]) < 0.15 and pitches[-1] > 0.2


@pytest.mark.parametrize("seed", range(8))
def test_any_target_gives_a_command_in_bounds_and_rates(ik: WholeBodyIK, seed: int) -> None:
    rng, who, settings = np.random.default_rng(seed), ObedientRobot(yaw=0.7), ik.settings
    step = np.zeros(command.SIZE)
    step[command.TORSO], step[command.HEIGHT] = settings.torso_rate * DT, settings.height_rate * DT
    step[command.ARMS] = settings.arm_rate * DT
    for _ in range(10):
        targets: list[np.ndarray | None] = [np.eye(4), np.eye(4)]
        for target in targets:
            target[:3, :3] = turn(2, rng.uniform(-3, 3)) @ turn(1, rng.uniform(-3, 3)) @ turn(0, rng.uniform(-3, 3))
            target[:3, 3] = rng.normal(size=3) * rng.choice([0.3, 3.0])
        solution = call(ik, who, targets)
        assert (solution.command >= command.LOWER).all() and (solution.command <= command.UPPER).all()
        assert (np.abs(solution.command - who.command) <= step + 1e-12).all()
        assert np.isfinite(solution.command).all()
        who.command = solution.command


def test_a_target_out_of_reach_is_said_to_be_missed_and_the_arms_come_to_rest(ik: WholeBodyIK) -> None:
    who, targets = ObedientRobot(), around(0.45, -0.1)
    who.follow(ik, targets, 25)
    before = who.command.copy()
    solution = who.follow(ik, targets, 1)
    missed = [np.linalg.norm(p[:3, 3] - t[:3, 3]) for p, t in zip(who.palms(), targets, strict=True)]
    np.testing.assert_allclose(solution.position_error, missed, atol=0.01)
    assert solution.position_error.min() > 0.1 and solution.planned_position_error.min() > 0.05
    assert np.abs(solution.command - before).max() < 0.05
    assert solution.command[command.HEIGHT] == pytest.approx(command.LOWER[command.HEIGHT], abs=1e-9)


def test_errors_are_those_of_the_palms(ik: WholeBodyIK) -> None:
    """With a torso that stands still, the reported errors are what MuJoCo measures, part of the way there too.

    To a few millimetres: the arms' sag is that where they are, not where they go.
    """
    who, targets = ObedientRobot(), around(0.5, 0.9)
    solution = call(ik, who, targets)
    who.command[command.ARMS] = solution.command[command.ARMS]  # the torso has not moved yet
    for index, (palm, target) in enumerate(zip(who.palms(), targets, strict=True)):
        assert solution.position_error[index] == pytest.approx(np.linalg.norm(palm[:3, 3] - target[:3, 3]), abs=5e-3)
        angle = np.arccos((np.trace(palm[:3, :3].T @ target[:3, :3]) - 1) / 2)
        assert solution.orientation_error[index] == pytest.approx(angle, abs=0.02)


def test_a_hand_without_target_keeps_its_arm(ik: WholeBodyIK) -> None:
    who = ObedientRobot()
    solution = who.follow(ik, [around(0.4, 0.7)[0], None], 10)
    np.testing.assert_array_equal(solution.command[command.RIGHT_ARM], command.rest()[command.RIGHT_ARM])
    assert solution.position_error[0] < 0.005
    assert solution.position_error[1] == solution.orientation_error[1] == 0.0
    kept = who.follow(ik, [None, None], 1).command
    np.testing.assert_array_equal(kept, solution.command)


def test_velocities_vanish_and_grippers_stay(ik: WholeBodyIK) -> None:
    who = ObedientRobot()
    who.command[command.VELOCITY], who.command[command.GRIPPERS] = 0.2, [0.3, 0.8]
    solution = call(ik, who, around(0.35, 0.7))
    assert (solution.command[command.VELOCITY] == 0.0).all()
    np.testing.assert_array_equal(solution.command[command.GRIPPERS], [0.3, 0.8])


def test_same_arguments_same_bits_whatever_came_before(ik: WholeBodyIK) -> None:
    who, targets = ObedientRobot(yaw=-0.4), around(0.35, 0.5)
    first = call(ik, who, targets).command
    call(ik, ObedientRobot(3.0, 1.0, 1.0), around(0.3, 2.0))
    call(ik, who, [None, targets[1]])
    again = call(ik, who, targets).command
    fresh = call(WholeBodyIK(robot.robot_spec("rubber").compile()), who, targets).command
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first, fresh)


def test_joints_beyond_their_limits_are_accepted(ik: WholeBodyIK) -> None:
    """Measured joints may pass a limit by a little, and a previous command may have been clipped."""
    who = ObedientRobot()
    T, q = who.measure()
    q[WAIST] = [0.0, 0.53, -0.53]
    solution = ik.solve(
        T_world_pelvis=T,
        joint_positions=q,
        T_world_left=around(0.3, 0.7)[0],
        T_world_right=None,
        previous=command.UPPER + 0.5,
    )
    assert (solution.command <= command.UPPER).all()


def test_what_is_not_a_number_is_refused(ik: WholeBodyIK) -> None:
    target = np.eye(4)
    target[0, 3] = np.nan
    with pytest.raises(CommandError, match="T_world_left with NaN"):
        call(ik, ObedientRobot(), [target, None])
    with pytest.raises(CommandError, match=r"T_world_right of shape \(3,\)"):
        call(ik, ObedientRobot(), [None, np.zeros(3)])


def test_settings_change_the_rates() -> None:
    slow = WholeBodyIK(robot.robot_spec("rubber").compile(), IKSettings(height_rate=0.1, torso_rate=0.2))
    who = ObedientRobot()
    solution = call(slow, who, around(0.35, 0.2))
    assert solution.command[command.HEIGHT] == pytest.approx(g1.PELVIS_HEIGHT - 0.01, abs=1e-9)
    assert solution.command[command.PITCH] == pytest.approx(0.02, abs=1e-9)


def test_the_torso_rises_no_higher_than_the_settings_let_it() -> None:
    heights = {}
    for highest in (0.742, math.inf):
        ik, who = WholeBodyIK(robot.robot_spec("rubber").compile(), IKSettings(highest=highest)), ObedientRobot()
        for _ in range(10):
            who.command = call(ik, who, around(0.35, 1.6)).command
        heights[highest] = who.command[command.HEIGHT]
    assert heights[0.742] == pytest.approx(0.742, abs=1e-9)
    assert heights[math.inf] == pytest.approx(command.UPPER[command.HEIGHT], abs=1e-9)


def test_torso_follows_the_head() -> None:
    who = ObedientRobot()
    ik = WholeBodyIK(who.model)
    who.palms()
    start = who.data.site("head_camera").xpos.copy()
    goal = np.eye(4)
    goal[:3, 3] = start + np.array([0.10, 0.0, -0.10])  # lean forward and down
    for _ in range(25):
        T_world_pelvis, q = who.measure()
        who.command = ik.solve(
            T_world_pelvis=T_world_pelvis,
            joint_positions=q,
            T_world_left=None,
            T_world_right=None,
            previous=who.command,
            T_world_head=goal,
        ).command
    who.palms()
    reached = who.data.site("head_camera").xpos
    assert np.linalg.norm(reached - goal[:3, 3]) < 0.4 * np.linalg.norm(start - goal[:3, 3])
    assert np.array_equal(who.command[command.ARMS], command.rest()[command.ARMS])


def test_gravity_costs_no_position(ik: WholeBodyIK) -> None:
    """Arms that sag by centimetres under gravity still bring the palms to within a millimetre."""
    who, targets = ObedientRobot(), around(0.45, 0.9)
    who.follow(ik, targets, 20)
    _, q = who.measure()
    sagged = np.linalg.norm(who.command[command.ARMS] - q[WAIST.stop :])
    assert sagged > 0.03
    for palm, target in zip(who.palms(), targets, strict=True):
        assert np.linalg.norm(palm[:3, 3] - target[:3, 3]) < 0.001


def test_a_walking_torso_stays_where_the_controller_lets_it(ik: WholeBodyIK) -> None:
    who, targets = ObedientRobot(), around(0.35, 0.3)
    for _ in range(20):
        T, q = who.measure()
        who.command = ik.solve(
            T_world_pelvis=T,
            joint_positions=q,
            T_world_left=targets[0],
            T_world_right=targets[1],
            previous=who.command,
            walking=True,
        ).command
    height, roll, pitch, yaw = who.command[command.TORSO]
    assert height == pytest.approx(reference.WALK_HEIGHT, abs=0.02) and height >= reference.WALK_HEIGHT - 1e-9
    assert roll == pytest.approx(0.0, abs=1e-9) and abs(yaw) <= reference.WALK_YAW
    assert 0.2 < pitch <= reference.WALK_PITCH[1] + 1e-9
