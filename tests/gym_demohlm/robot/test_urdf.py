"""The URDF of the robot against MuJoCo: the same frames at the same joint angles."""

import mujoco
import numpy as np
import placo
import pytest

from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.robot import robot
from gym_demohlm.robot.urdf import urdf


def largest_difference(model: mujoco.MjModel, root: str, rng: np.random.Generator, frames: list[str]) -> float:
    """Largest difference [m or 1] of any frame's pose in the root frame at one random configuration."""
    wrapper = placo.RobotWrapper("", placo.Flags.ignore_collisions, urdf(model, root))
    wrapper.set_T_world_fbase(np.eye(4))
    data = mujoco.MjData(model)
    available = set(wrapper.joint_names())
    for index in range(model.njnt):
        joint = model.joint(index)
        if joint.type[0] == mujoco.mjtJoint.mjJNT_FREE:
            continue
        angle = rng.uniform(*joint.range)
        data.joint(index).qpos = angle
        if joint.name in available:
            wrapper.set_joint(joint.name, angle)
    wrapper.update_kinematics()
    mujoco.mj_kinematics(model, data)
    R_root, p_root = data.body(root).xmat.reshape(3, 3), data.body(root).xpos
    worst = 0.0
    for frame in frames:
        is_body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, frame) >= 0
        view = data.body(frame) if is_body else data.site(frame)
        T = wrapper.get_T_world_frame(frame)
        worst = max(worst, np.abs(T[:3, 3] - R_root.T @ (view.xpos - p_root)).max())
        worst = max(worst, np.abs(T[:3, :3] - R_root.T @ view.xmat.reshape(3, 3)).max())
    return worst


@pytest.mark.parametrize("kind", ["rubber", "gripper"])
def test_every_frame_agrees_with_mujoco(kind: str) -> None:
    model = robot.robot_spec(kind).compile()
    bodies = [model.body(index).name for index in range(1, model.nbody)]
    sites = [model.site(index).name for index in range(model.nsite)]
    assert {"left_palm", "right_palm", "head_camera"} <= set(sites)
    rng = np.random.default_rng(1)
    assert max(largest_difference(model, "pelvis", rng, bodies + sites) for _ in range(5)) < 1e-9


def test_a_subtree_has_its_own_root_and_nothing_else() -> None:
    model = robot.robot_spec("rubber").compile()
    text = urdf(model, "torso_link")
    assert "knee" not in text and "left_elbow_joint" in text
    assert largest_difference(model, "torso_link", np.random.default_rng(2), ["left_palm", "neck_pitch_link"]) < 1e-9


def test_locked_joints_are_fixed_at_zero() -> None:
    model = robot.robot_spec("rubber").compile()
    wrapper = placo.RobotWrapper("", placo.Flags.ignore_collisions, urdf(model, locked={"left_knee_joint"}))
    assert "left_knee_joint" not in set(wrapper.joint_names())
    assert "right_knee_joint" in set(wrapper.joint_names())


def test_anchors_references_and_steep_rotations_survive() -> None:
    """A joint away from its body's origin, one with a reference angle, and a body turned by 90 degrees of pitch."""
    spec = mujoco.MjSpec.from_string("""
    <mujoco><worldbody><body name="pelvis"><geom size="0.1"/>
      <body name="a" pos="0.1 0.2 0.3" euler="10 90 -35"><geom size="0.1"/>
        <joint name="hinge" pos="0.05 -0.02 0.1" axis="0.6 0 0.8" range="-60 70" ref="25"/>
        <body name="b" pos="0 0 0.4" euler="0 -90 20"><geom size="0.1"/>
          <joint name="slide" type="slide" axis="0 0.6 0.8" range="-0.1 0.3" ref="0.05"/>
          <site name="tip" pos="0.1 0 0" euler="0 90 0"/></body></body></body></worldbody></mujoco>""")
    model = spec.compile()
    rng = np.random.default_rng(3)
    assert max(largest_difference(model, "pelvis", rng, ["a", "b", "tip"]) for _ in range(5)) < 1e-9


def test_what_urdf_cannot_say_is_refused() -> None:
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody><body name="pelvis"><geom size="0.1"/><body name="ball"><joint type="ball"/>
    <geom size="0.1"/></body></body></worldbody></mujoco>""")
    with pytest.raises(SceneError, match="one hinge or slide"):
        urdf(model)
    with pytest.raises(UnknownNameError, match="pelvis"):
        urdf(model, "pelvi")
