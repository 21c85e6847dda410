"""Versions of the robot's physics: the first is what it was, the second stops itself, rubs and is as strong as a G1."""

from itertools import combinations

import mujoco
import numpy as np
import pytest

from gym_demohlm.robot import g1, hands, robot
from gym_demohlm.robot.physics import FIRST, PHYSICS, SECOND, VERSIONS, Physics

KINDS = pytest.mark.parametrize("kind", hands.HANDS)


def _model(kind: hands.Hands, physics: Physics) -> mujoco.MjModel:
    return robot.robot_spec(kind, physics).compile()


def _touching(model: mujoco.MjModel, pose: np.ndarray) -> set[frozenset[str]]:
    """Return the pairs of geoms that touch in a pose of the body joints (29,), high over the floor."""
    data = mujoco.MjData(model)
    data.qpos[2] = 3.0
    for joint, angle in zip(g1.BODY_JOINTS, pose, strict=True):
        data.joint(f"{joint}_joint").qpos = angle
    mujoco.mj_fwdPosition(model, data)
    return {frozenset(model.geom(int(geom)).name for geom in contact.geom) for contact in data.contact}


def _pose(**angles: float) -> np.ndarray:
    pose = g1.HOME.copy()
    for joint, angle in angles.items():
        pose[g1.BODY_JOINTS.index(joint)] = angle
    return pose


def test_versions_are_told_apart_by_name() -> None:
    assert PHYSICS in VERSIONS.values()
    for first, second in combinations(VERSIONS.values(), 2):
        assert first.name != second.name


@KINDS
def test_at_home_nothing_touches(kind: hands.Hands) -> None:
    assert _touching(_model(kind, SECOND), g1.HOME) == set()


@pytest.mark.parametrize(
    ("pose", "first", "second"),
    [
        (_pose(left_shoulder_roll=-0.6, left_elbow=1.2), "left_elbow_yaw_collision", "torso_collision"),
        (_pose(left_hip_roll=-0.3, right_hip_roll=0.3), "left_shin_collision", "right_shin_collision"),
        (_pose(left_hip_roll=-0.17, right_hip_roll=0.17), "left_foot_collision", "right_foot_collision"),
    ],
)
def test_arms_legs_and_feet_stop_one_another_in_the_second_physics(pose: np.ndarray, first: str, second: str) -> None:
    pair = frozenset((first, second))
    assert pair not in _touching(_model("rubber", FIRST), pose)
    assert pair in _touching(_model("rubber", SECOND), pose)


@KINDS
def test_joints_rub_and_motors_are_limited(kind: hands.Hands) -> None:
    first, second = _model(kind, FIRST), _model(kind, SECOND)
    for joint in g1.BODY_JOINTS:
        drive, address = g1.motor(joint), first.joint(f"{joint}_joint").dofadr[0]
        rubs = 0.0 if joint in g1.ARM_JOINTS else drive.dry_friction
        assert (first.dof_frictionloss[address], second.dof_frictionloss[address]) == (0.0, rubs)
        assert first.actuator(joint).forcerange[1] == drive.torque_limit
        assert second.actuator(joint).forcerange[1] == drive.peak_torque
        assert 0 < drive.peak_torque <= drive.torque_limit


def test_a_slow_joint_comes_to_rest_by_its_friction() -> None:
    """Without gravity and servos, a knee pushed by less than its friction does not move."""
    model = _model("rubber", SECOND)
    model.opt.gravity[:] = 0
    model.actuator_gainprm[:], model.actuator_biasprm[:] = 0, 0
    data, knee = mujoco.MjData(model), model.joint("left_knee_joint").dofadr[0]
    moved = {}
    for share in (0.8, 2.0):
        mujoco.mj_resetData(model, data)
        data.qfrc_applied[knee] = share * g1.motor("left_knee").dry_friction
        mujoco.mj_step(model, data, 100)
        moved[share] = abs(data.qvel[knee])
    assert moved[0.8] < 0.01 < 0.3 < moved[2.0]  # rad/s
