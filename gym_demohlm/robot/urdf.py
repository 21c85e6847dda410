"""A compiled MuJoCo model -> URDF text of one of its kinematic trees, for libraries that read no MJCF.

Bodies become links of the same name, joints keep their names, and sites become links on fixed joints. Numbers carry all
17 digits, so forward kinematics agree with MuJoCo's to rounding.
"""

import math
from collections.abc import Collection
from xml.etree import ElementTree

import mujoco
import numpy as np

from gym_demohlm.errors import SceneError, UnknownNameError

_TYPES = {int(mujoco.mjtJoint.mjJNT_HINGE): "revolute", int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic"}
_EFFORT, _VELOCITY = "100", "20"  # URDF demands them; kinematics ignores them


def urdf(model: mujoco.MjModel, root: str = "pelvis", locked: Collection[str] = ()) -> str:
    """Return the URDF of the tree below a body.

    Args:
        model: The compiled model; bodies outside the tree are left out.
        root: Name of the body that becomes the root link. Its own joints are left out.
        locked: Joints to fix at their zero position, for a smaller problem.

    Raises:
        UnknownNameError: There is no body `root`.
        SceneError: A body of the tree has two joints, or a ball joint.
    """
    names = [model.body(index).name for index in range(model.nbody)]
    if root not in names:
        raise UnknownNameError("body", root, names)
    robot = ElementTree.Element("robot", name=root)
    root_id = names.index(root)
    tree = {root_id}
    for body in range(root_id, model.nbody):  # parents come before their children
        if body != root_id:
            if model.body_parentid[body] not in tree:
                continue
            tree.add(body)
            _add_joint(robot, model, body, locked)
        _add_link(robot, model, body)
    for site in range(model.nsite):
        if model.site_bodyid[site] in tree and model.site(site).name:
            name, parent = model.site(site).name, names[model.site_bodyid[site]]
            ElementTree.SubElement(robot, "link", name=name)
            T = _transform(model.site_pos[site], model.site_quat[site])
            joint = _new_joint(robot, f"{name}_fixed", "fixed", parent, name)
            _add_origin(joint, T)
    return ElementTree.tostring(robot, encoding="unicode")


def _add_link(robot: ElementTree.Element, model: mujoco.MjModel, body: int) -> None:
    link = ElementTree.SubElement(robot, "link", name=model.body(body).name)
    inertial = ElementTree.SubElement(link, "inertial")
    _add_origin(inertial, _transform(model.body_ipos[body], model.body_iquat[body]))
    ElementTree.SubElement(inertial, "mass", value=_text(model.body_mass[body]))
    ixx, iyy, izz = (_text(moment) for moment in model.body_inertia[body])
    ElementTree.SubElement(inertial, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy="0", ixz="0", iyz="0")


def _add_joint(robot: ElementTree.Element, model: mujoco.MjModel, body: int, locked: Collection[str]) -> None:
    """Add the joint between a body and its parent.

    MuJoCo turns a body about a point of its own frame, URDF about the child's origin: a joint whose point is not the
    origin gets an empty link there. A joint's zero in MuJoCo is `qpos0`, folded into the origin here.
    """
    name, parent = model.body(body).name, model.body(model.body_parentid[body]).name
    T_parent_body = _transform(model.body_pos[body], model.body_quat[body])
    if model.body_jntnum[body] == 0:
        _add_origin(_new_joint(robot, f"{name}_fixed", "fixed", parent, name), T_parent_body)
        return
    index = int(model.body_jntadr[body])
    joint_name, kind = model.joint(index).name, _TYPES.get(int(model.jnt_type[index]))
    if kind is None or model.body_jntnum[body] > 1:
        raise SceneError(f"body {name!r} with joint {joint_name!r}", "one hinge or slide a body", "split the body")
    axis, anchor = model.jnt_axis[index], model.jnt_pos[index]
    T_zero = np.eye(4)
    zero = model.qpos0[model.jnt_qposadr[index]]
    if kind == "revolute":
        quat_wxyz = np.zeros(4)
        mujoco.mju_axisAngle2Quat(quat_wxyz, axis, -zero)
        T_zero = _transform(np.zeros(3), quat_wxyz)
    else:
        T_zero[:3, 3] = -zero * axis
    T_body_anchor = np.eye(4)
    T_body_anchor[:3, 3] = anchor
    child = f"{name}_anchor" if anchor.any() else name
    joint = _new_joint(robot, joint_name, "fixed" if joint_name in locked else kind, parent, child)
    _add_origin(joint, T_parent_body @ T_body_anchor @ T_zero)
    if joint_name not in locked:
        ElementTree.SubElement(joint, "axis", xyz=_text(axis))
        limited = bool(model.jnt_limited[index])
        lower, upper = model.jnt_range[index] if limited else (-1e3, 1e3)
        limits = {"lower": _text(lower), "upper": _text(upper), "effort": _EFFORT, "velocity": _VELOCITY}
        ElementTree.SubElement(joint, "limit", limits)
    if child != name:
        ElementTree.SubElement(robot, "link", name=child)
        T_anchor_body = np.eye(4)
        T_anchor_body[:3, 3] = -anchor
        _add_origin(_new_joint(robot, f"{name}_fixed", "fixed", child, name), T_anchor_body)


def _new_joint(robot: ElementTree.Element, name: str, kind: str, parent: str, child: str) -> ElementTree.Element:
    joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    return joint


def _add_origin(element: ElementTree.Element, T: np.ndarray) -> None:
    ElementTree.SubElement(element, "origin", xyz=_text(T[:3, 3]), rpy=_text(_roll_pitch_yaw(T[:3, :3])))


def _transform(position: np.ndarray, quat_wxyz: np.ndarray) -> np.ndarray:
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, quat_wxyz)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.reshape(3, 3), position
    return T


def _roll_pitch_yaw(R: np.ndarray) -> np.ndarray:
    """Return URDF's fixed-axis angles, R = Rz(yaw) Ry(pitch) Rx(roll) [rad]; exact near a pitch of 90 degrees too.

    Yaw comes first; roll is then measured in the frame turned back by it, which is well defined at any pitch.
    """
    yaw = math.atan2(R[1, 0], R[0, 0]) if math.hypot(R[0, 0], R[1, 0]) > 1e-9 else 0.0
    cosine, sine = np.cos(yaw), np.sin(yaw)
    pitch = math.atan2(-R[2, 0], cosine * R[0, 0] + sine * R[1, 0])
    roll = math.atan2(sine * R[0, 2] - cosine * R[1, 2], cosine * R[1, 1] - sine * R[0, 1])
    return np.array([roll, pitch, yaw])


def _text(values: np.ndarray | float) -> str:
    return " ".join(f"{value:.17g}" for value in np.atleast_1d(values))
