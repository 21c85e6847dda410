"""Desired poses of the palms, in the world -> the command whose torso and arms bring them there.

Two quadratic problems a call, with placo's kinematics and solver. The torso pass sees the robot as the whole-body
controller moves it: from where its pelvis is measured, four joints that are the command itself (height, yaw, pitch,
roll) carry the torso, and the pelvis of a standing robot backs off as they bend it (left out, the hands seem to fall
short after every bend, and it bends until it is doubled up). The arm pass moves the arms alone on the torso as it is
measured now, so the hands are right while the torso is still on its way. It solves for where the arms shall be; the
command is that and what the PD servos of the arms sag under gravity, so no error has to build up first, and a squeeze
gains no force with time. Bounds and rates are limits inside the problems: an unreachable target stretches the robot
and stops.
"""

from dataclasses import dataclass
from xml.etree import ElementTree

import mujoco
import numpy as np

from gym_demohlm.arithmetic import arctan2, hypot, transposed_product
from gym_demohlm.control import command, reference
from gym_demohlm.control.ik_pass import Advance, Pass
from gym_demohlm.control.ik_settings import IKSettings
from gym_demohlm.control.kernels import ik as kernels
from gym_demohlm.control.shoulder_room import ShoulderRoom
from gym_demohlm.control.whole_body import Weights
from gym_demohlm.errors import CommandError
from gym_demohlm.robot import g1
from gym_demohlm.robot.urdf import urdf
from gym_demohlm.timing import STEP_DT

_ARMS = (command.LEFT_ARM, command.RIGHT_ARM)
_ROOT, _TORSO = "heading", "torso_link"
# From the floor up; each name is a joint of the torso pass and an entry of the command.
_TORSO_AXES = (("torso_height", "0 0 1"), ("torso_yaw", "0 0 1"), ("torso_pitch", "0 1 0"), ("torso_roll", "1 0 0"))
_PITCH = [name for name, _ in _TORSO_AXES].index("torso_pitch")
_TORSO_COLUMNS = [command.NAMES.index(f"{name}.pos") for name, _ in _TORSO_AXES]
_COLUMNS = np.array([*_TORSO_COLUMNS, *range(command.SIZE)[command.ARMS]])
_IS_ELBOW = np.array([name.endswith("elbow.pos") for name in command.NAMES])
_WALK_LOWER, _WALK_UPPER = command.LOWER.copy(), command.UPPER.copy()
_WALK_LOWER[command.TORSO] = [reference.WALK_HEIGHT, 0.0, reference.WALK_PITCH[0], -reference.WALK_YAW]
_WALK_UPPER[command.TORSO] = [command.UPPER[command.HEIGHT], 0.0, reference.WALK_PITCH[1], reference.WALK_YAW]


@dataclass(frozen=True, kw_only=True)
class IKSolution:
    """The command and what it leaves. Errors of a hand without a target are zero.

    Attributes:
        command: (23,) with no velocity and the grippers of the previous command.
        position_error: Distance of each palm from its target with the new arms on the torso as measured, (2,) [m].
        orientation_error: Angle likewise, (2,) [rad].
        planned_position_error: Distance that would be left once the torso has obeyed this command, (2,) [m].
    """

    command: np.ndarray
    position_error: np.ndarray
    orientation_error: np.ndarray
    planned_position_error: np.ndarray


class WholeBodyIK:
    """Inverse kinematics of the upper body; `solve` is a function of its arguments and remembers nothing."""

    def __init__(self, model: mujoco.MjModel, settings: IKSettings | None = None) -> None:
        """Build both problems.

        Args:
            model: Any model that contains the robot.
            settings: Rates and weights; the defaults if not given.
        """
        self.settings = settings or IKSettings()
        self._model, self._data = model, mujoco.MjData(model)
        self._room = ShoulderRoom(model)
        self._ahead = Weights().make_reference().ahead
        self._rates = np.zeros(command.SIZE)
        self._rates[command.TORSO], self._rates[command.HEIGHT] = self.settings.torso_rate, self.settings.height_rate
        self._rates[command.ARMS] = self.settings.arm_rate
        self._straightest = np.where(_IS_ELBOW, self.settings.straightest_elbow, np.inf)
        standing, walking = (command.LOWER, command.UPPER), (_WALK_LOWER, _WALK_UPPER)
        self._bounds = [(low.copy(), high.copy()) for low, high in (standing, walking)]
        for low, high in self._bounds:
            low[command.PITCH] = max(low[command.PITCH], self.settings.furthest_back)
            high[command.HEIGHT] = min(high[command.HEIGHT], self.settings.highest)
        qpos_address = {name: int(model.joint(_joint(name)).qposadr[0]) for name in g1.BODY_JOINTS}
        self._qpos = np.array([qpos_address[name] for name in g1.BODY_JOINTS])
        self._pelvis, self._torso = model.body("pelvis").id, model.body(_TORSO).id
        self._base_quat = int(model.joint(model.body_jntadr[self._pelvis]).qposadr[0]) + 3
        self._arm_dofs = np.array([int(model.joint(_joint(name)).dofadr[0]) for name in g1.ARM_JOINTS])
        self._arm_stiffness = np.array([g1.motor(name).stiffness for name in g1.ARM_JOINTS])  # (14,) [Nm/rad]

        arms = {_joint(name) for name in g1.ARM_JOINTS}
        others = {model.joint(index).name for index in range(model.njnt)} - arms
        upper_body = urdf(model, _TORSO, locked=others)
        T_pelvis_torso = self._pelvis_to_torso(np.zeros(len(g1.BODY_JOINTS)), np.eye(4))
        home = dict(zip(g1.ARM_JOINTS, g1.HOME[-len(g1.ARM_JOINTS) :], strict=True))
        weights = self.settings
        arm_pulls = {name: (angle, weights.arm_posture_weight) for name, angle in home.items()}
        hand = (weights.arm_position_weight, weights.arm_orientation_weight)
        self._arm_pass = Pass(upper_body, _of_joints(arm_pulls), hand, weights)
        torso_pulls = {
            "torso_height": (g1.PELVIS_HEIGHT, weights.height_weight),
            "torso_yaw": (0.0, weights.yaw_weight),
            "torso_pitch": (0.0, weights.pitch_weight),
            "torso_roll": (0.0, weights.roll_weight),
        } | {name: (angle, weights.torso_posture_weight) for name, angle in home.items()}
        hand = (weights.torso_position_weight, weights.torso_orientation_weight)
        on_torso_joints = _on_torso_joints(upper_body, T_pelvis_torso[:3, 3])
        self._torso_pass = Pass(on_torso_joints, _of_joints(torso_pulls), hand, weights)

    def solve(
        self,
        *,
        T_world_pelvis: np.ndarray,
        joint_positions: np.ndarray,
        T_world_left: np.ndarray | None,
        T_world_right: np.ndarray | None,
        previous: np.ndarray,
        T_world_head: np.ndarray | None = None,
        T_world_heading: np.ndarray | None = None,
        walking: bool = False,
        dt: float = STEP_DT,
    ) -> IKSolution:
        """Return the command that brings the palms to their targets, or as near as one step of `dt` gets.

        Args:
            T_world_pelvis: Measured pose of the pelvis, (4, 4); or expected, see `foresight`.
            joint_positions: Likewise, in `g1.BODY_JOINTS` order, (29,) [rad].
            T_world_left: Target of ``left_palm``, (4, 4); None keeps the previous arm.
            T_world_right: Target of ``right_palm``, likewise.
            previous: The command before, (23,); changes are limited to the rates of the settings times `dt`.
            T_world_head: Target of ``head_camera``, (4, 4), of which the torso pass follows the position; None leaves
                the torso to the hands alone.
            T_world_heading: Where the torso pass lets the robot stand, (4, 4) on the floor; else below the pelvis.
            walking: Whether the torso must stay where the controller lets it while it steps.
            dt: Time since then [s].

        Raises:
            CommandError: An argument has another shape or is not finite.
        """
        previous = np.clip(_checked("previous", previous, (command.SIZE,)), command.LOWER, command.UPPER)
        T_world_pelvis = _checked("T_world_pelvis", T_world_pelvis, (4, 4))
        joint_positions = _checked("joint_positions", joint_positions, (len(g1.BODY_JOINTS),))
        targets = [
            None if target is None else _checked(name, target, (4, 4))
            for name, target in (("T_world_left", T_world_left), ("T_world_right", T_world_right))
        ]
        head = None if T_world_head is None else _checked("T_world_head", T_world_head, (4, 4))[:3, 3]
        if T_world_heading is None:
            T_world_heading = _heading(T_world_pelvis)
        T_world_heading = _checked("T_world_heading", T_world_heading, (4, 4))
        lower, upper, bent = self._window(previous, dt, walking)
        solution = previous.copy()
        solution[command.VELOCITY] = 0.0

        T_world_torso = T_world_pelvis @ self._pelvis_to_torso(joint_positions, T_world_pelvis)
        advance = None if walking else self._advance(T_world_pelvis[2, 3], T_world_torso[2])
        planned = self._torso_pass.solve(
            T_world_heading,
            np.minimum(previous, bent)[_COLUMNS],
            lower[_COLUMNS],
            bent[_COLUMNS],
            targets,
            head,
            advance,
        )
        planned_errors = self._torso_pass.errors(targets)
        if head is not None or any(target is not None for target in targets):
            solution[_TORSO_COLUMNS] = planned[: len(_TORSO_COLUMNS)]
        sag = self._sag()
        start, lowest, highest = (bound[command.ARMS] - sag for bound in (previous, lower, upper))
        arms = self._arm_pass.solve(T_world_torso, start, lowest, highest, targets)
        solution[command.ARMS] = np.clip(arms + sag, lower[command.ARMS], upper[command.ARMS])
        for arm, target in zip(_ARMS, targets, strict=True):
            if target is None:
                solution[arm] = previous[arm]
        position_error, orientation_error = kernels.lengths(self._arm_pass.errors(targets))
        return IKSolution(
            command=solution,
            position_error=position_error,
            orientation_error=orientation_error,
            planned_position_error=kernels.lengths(planned_errors)[0],
        )

    def _window(self, previous: np.ndarray, dt: float, walking: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the bounds of the next command, (23,) each: its own bounds met with what the rates allow.

        A robot that starts to walk while it bends further than it may has its torso brought back at the fastest rate,
        and so has a shoulder that is rolled further inwards than the trunk lets it. The third are upper bounds of the
        torso pass, whose elbows stay bent.
        """
        lower, upper, bent = np.empty((3, command.SIZE))
        bounds = self._room.narrow(previous, *self._bounds[walking])
        kernels.window(previous, self._rates * dt, *bounds, self._straightest, lower, upper, bent)
        return lower, upper, bent

    def _advance(self, height: float, third_row: np.ndarray) -> Advance:
        """Return how the pelvis backs off from where it is [m], the torso having this third row of its rotation."""
        pitch = float(arctan2(-third_row[0], hypot(third_row[1], third_row[2])))
        here, _, _ = kernels.pelvis_ahead(self._ahead, height, pitch)
        return Advance(ahead=self._ahead, here=here, pitch=_PITCH)

    def _sag(self) -> np.ndarray:
        """Return how far gravity holds the arms back from their targets, where `_pelvis_to_torso` put them, (14,)."""
        mujoco.mj_comPos(self._model, self._data)
        torques = np.zeros(self._model.nv)
        mujoco.mj_rne(self._model, self._data, 0, torques)  # at rest: what holds the robot against gravity
        return torques[self._arm_dofs] / self._arm_stiffness

    def _pelvis_to_torso(self, joint_positions: np.ndarray, T_world_pelvis: np.ndarray) -> np.ndarray:
        """Return the torso's pose in the pelvis frame, (4, 4); leave the kinematics there."""
        self._data.qpos[self._qpos] = joint_positions
        quat_wxyz = self._data.qpos[self._base_quat : self._base_quat + 4]
        mujoco.mju_mat2Quat(quat_wxyz, T_world_pelvis[:3, :3].reshape(9))
        mujoco.mj_kinematics(self._model, self._data)
        rotations, positions = self._data.xmat, self._data.xpos
        R_world_pelvis = rotations[self._pelvis].reshape(3, 3)
        T_pelvis_torso = np.eye(4)
        T_pelvis_torso[:3, :3] = R_world_pelvis.T @ rotations[self._torso].reshape(3, 3)
        T_pelvis_torso[:3, 3] = transposed_product(R_world_pelvis, positions[self._torso] - positions[self._pelvis])
        return T_pelvis_torso


def _on_torso_joints(upper_body: str, p_pelvis_torso: np.ndarray) -> str:
    """Return the URDF of the upper body on the four joints of the torso command.

    Yaw turns about the pelvis origin; pitch and roll about the waist, `p_pelvis_torso` away [m]. In the order yaw,
    pitch, roll the joint angles are the torso's yaw, pitch and roll with respect to gravity.
    """
    robot = ElementTree.fromstring(upper_body)
    parent = _ROOT
    ElementTree.SubElement(robot, "link", name=parent)
    for index, (name, axis) in enumerate(_TORSO_AXES):
        child = _TORSO if index == len(_TORSO_AXES) - 1 else f"{name}_link"
        if child != _TORSO:
            ElementTree.SubElement(robot, "link", name=child)
        kind = "prismatic" if name == "torso_height" else "revolute"
        joint = ElementTree.SubElement(robot, "joint", name=_joint(name), type=kind)
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=child)
        offset = p_pelvis_torso if name == "torso_pitch" else np.zeros(3)
        ElementTree.SubElement(joint, "origin", xyz=" ".join(f"{value:.17g}" for value in offset), rpy="0 0 0")
        ElementTree.SubElement(joint, "axis", xyz=axis)
        ElementTree.SubElement(joint, "limit", lower="-2", upper="2", effort="100", velocity="20")
        parent = child
    return ElementTree.tostring(robot, encoding="unicode")


def _joint(name: str) -> str:
    return f"{name}_joint"


def _of_joints(pulls: dict[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    return {_joint(name): pull for name, pull in pulls.items()}


def _heading(T_world_pelvis: np.ndarray) -> np.ndarray:
    """Return the frame on the floor below the pelvis, turned with it about the vertical, (4, 4)."""
    yaw = arctan2(T_world_pelvis[1, 0], T_world_pelvis[0, 0])
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:2, 3] = T_world_pelvis[:2, 3]
    return T


def _checked(name: str, value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        got = f"{name} of shape {array.shape}" if array.shape != shape else f"{name} with NaN or infinity"
        raise CommandError(got, f"finite numbers of shape {shape}", "check what computed it")
    return array
