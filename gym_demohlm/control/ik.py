"""Desired poses of the palms, in the world -> the command whose torso and arms bring them there.

Two quadratic programs a call, both solved by placo. The torso pass sees the robot as the whole-body controller moves it:
pelvis x, y and heading are as measured, and four joints that are the command itself (height, yaw, pitch, roll) carry the
torso. The arm pass moves the arms alone on the torso as it is measured now, so the hands are right while the torso is
still on its way. Bounds and rates are limits inside the programs: an unreachable target stretches the robot and stops.
"""

from dataclasses import dataclass, field
from xml.etree import ElementTree

import mujoco
import numpy as np
import placo

from gym_demohlm.control import command
from gym_demohlm.errors import CommandError
from gym_demohlm.robot import g1
from gym_demohlm.robot.urdf import urdf

_PALMS = ("left_palm", "right_palm")
_ARMS = (command.LEFT_ARM, command.RIGHT_ARM)
_ROOT, _TORSO = "heading", "torso_link"
# From the floor up; each name is a joint of the torso pass and an entry of the command.
_TORSO_AXES = (("torso_height", "0 0 1"), ("torso_yaw", "0 0 1"), ("torso_pitch", "0 1 0"), ("torso_roll", "1 0 0"))
_TORSO_COLUMNS = [command.NAMES.index(f"{name}.pos") for name, _ in _TORSO_AXES]
_ARM_COLUMNS = [*range(command.SIZE)[command.ARMS]]


@dataclass(frozen=True, kw_only=True)
class IKSettings:
    """Rates, weights and effort of the solver. Weights multiply squared errors in metres and radians.

    Attributes:
        height_rate: Fastest change of the torso height [m/s].
        torso_rate: Fastest change of torso roll, pitch and yaw [rad/s].
        arm_rate: Fastest change of an arm joint [rad/s].
        hand_position_weight: Pull of a palm to its target position.
        torso_orientation_weight: Pull of a palm to its target orientation, in the torso pass.
        arm_orientation_weight: The same in the arm pass.
        height_weight: Pull of the torso height to `g1.PELVIS_HEIGHT`.
        pitch_weight: Pull of the torso to upright; weak, so that low targets bend it before they bend the knees.
        yaw_weight: Pull of the torso yaw to straight ahead.
        roll_weight: Pull of the torso roll to zero.
        torso_posture_weight: Pull of the arms to the home posture, in the torso pass.
        arm_posture_weight: The same in the arm pass; it chooses the elbow's height.
        regularization: Damping of each step.
        error_damping: More of it, times the hands' weighted squared error.
        iterations: Quadratic programs a pass.
    """

    height_rate: float = 0.3
    torso_rate: float = 0.8
    arm_rate: float = 4.0
    hand_position_weight: float = 10.0
    torso_orientation_weight: float = 0.05
    arm_orientation_weight: float = 0.5
    height_weight: float = 0.15
    pitch_weight: float = 0.01
    yaw_weight: float = 0.1
    roll_weight: float = 1.0
    torso_posture_weight: float = 0.001
    arm_posture_weight: float = 0.001
    regularization: float = 1e-4
    error_damping: float = 0.5
    iterations: int = 2


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


@dataclass
class _Pass:
    """One placo problem: a robot on a fixed base, its joints, two palm tasks and a posture."""

    description: str
    joints: tuple[str, ...]
    orientation_weight: float
    posture_weight: float
    settings: IKSettings
    offsets: list[int] = field(init=False)

    def __post_init__(self) -> None:
        self.robot = placo.RobotWrapper("", placo.Flags.ignore_collisions, self.description)
        self.solver = placo.KinematicsSolver(self.robot)
        self.solver.mask_fbase(True)
        self.solver.enable_joint_limits(True)
        self.damping = self.solver.add_regularization_task(self.settings.regularization)
        self.palms = [self.solver.add_frame_task(palm, np.eye(4)) for palm in _PALMS]
        home = g1.HOME[-len(g1.ARM_JOINTS) :]
        self.pull(dict(zip(g1.ARM_JOINTS, home, strict=True)), "arm_posture", self.posture_weight)
        self.offsets = [self.robot.get_joint_offset(_joint(name)) for name in self.joints]

    def pull(self, posture: dict[str, float], name: str, weight: float) -> None:
        """Pull joints to a posture with a weight."""
        task = self.solver.add_joints_task()
        task.set_joints({_joint(joint): float(angle) for joint, angle in posture.items()})
        task.configure(name, "soft", weight)

    def solve(
        self,
        T_world_base: np.ndarray,
        start: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        targets: list[np.ndarray | None],
    ) -> np.ndarray:
        """Return the joints nearest the targets, within [lower, upper], starting from `start`."""
        q = np.zeros(len(self.robot.state.q))
        q[6] = 1.0
        q[self.offsets] = start
        self.robot.state.q = q
        for name, low, high in zip(self.joints, lower, upper, strict=True):
            self.robot.set_joint_limits(_joint(name), float(low), float(high))
        self.robot.update_kinematics()
        self.robot.set_T_world_fbase(T_world_base)
        self.robot.update_kinematics()
        for index, (task, target) in enumerate(zip(self.palms, targets, strict=True)):
            weighted = target is not None
            if target is not None:
                task.T_world_frame = target
            position_weight = self.settings.hand_position_weight if weighted else 0.0
            task.configure(_PALMS[index], "soft", position_weight, self.orientation_weight if weighted else 0.0)
        for _ in range(self.settings.iterations):
            # Levenberg-Marquardt with the error as damping (Sugihara 2011): a stretched arm stays still, not swinging.
            position, orientation = self.errors(targets)
            cost = self.settings.hand_position_weight * position @ position
            cost += self.orientation_weight * orientation @ orientation
            self.damping.configure("damping", "soft", self.settings.regularization + self.settings.error_damping * cost)
            self.solver.solve(True)
            self.robot.update_kinematics()
        q = np.clip(np.array(self.robot.state.q)[self.offsets], lower, upper)
        self.move(q)
        return q

    def move(self, q: np.ndarray) -> None:
        """Put the robot into joints `q` on the base it stands on."""
        state = np.array(self.robot.state.q)
        state[self.offsets] = q
        self.robot.state.q = state
        self.robot.update_kinematics()

    def errors(self, targets: list[np.ndarray | None]) -> tuple[np.ndarray, np.ndarray]:
        """Return the palms' distances (2,) [m] and angles (2,) [rad] from their targets."""
        position, orientation = np.zeros(2), np.zeros(2)
        for index, (palm, target) in enumerate(zip(_PALMS, targets, strict=True)):
            if target is not None:
                T = self.robot.get_T_world_frame(palm)
                position[index] = np.linalg.norm(T[:3, 3] - target[:3, 3])
                # The chord of a rotation, |R1 - R2| = 2 sqrt(2) sin(angle / 2), is accurate at small angles.
                chord = np.linalg.norm(T[:3, :3] - target[:3, :3]) / np.sqrt(8.0)
                orientation[index] = 2 * np.arcsin(min(chord, 1.0))
        return position, orientation


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
        qpos_address = {name: int(model.joint(_joint(name)).qposadr[0]) for name in g1.BODY_JOINTS}
        self._qpos = np.array([qpos_address[name] for name in g1.BODY_JOINTS])
        self._pelvis, self._torso = model.body("pelvis").id, model.body(_TORSO).id

        arms = {_joint(name) for name in g1.ARM_JOINTS}
        others = {model.joint(index).name for index in range(model.njnt)} - arms
        upper_body = urdf(model, _TORSO, locked=others)
        T_pelvis_torso = self._pelvis_to_torso(np.zeros(len(g1.BODY_JOINTS)))
        self._arm_pass = _Pass(
            upper_body,
            g1.ARM_JOINTS,
            self.settings.arm_orientation_weight,
            self.settings.arm_posture_weight,
            self.settings,
        )
        torso_names = tuple(name for name, _ in _TORSO_AXES)
        self._torso_pass = _Pass(
            _on_torso_joints(upper_body, T_pelvis_torso[:3, 3]),
            torso_names + g1.ARM_JOINTS,
            self.settings.torso_orientation_weight,
            self.settings.torso_posture_weight,
            self.settings,
        )
        pull = self._torso_pass.pull
        pull({"torso_height": g1.PELVIS_HEIGHT}, "height", self.settings.height_weight)
        pull({"torso_pitch": 0.0}, "pitch", self.settings.pitch_weight)
        pull({"torso_yaw": 0.0}, "yaw", self.settings.yaw_weight)
        pull({"torso_roll": 0.0}, "roll", self.settings.roll_weight)

    def solve(
        self,
        *,
        T_world_pelvis: np.ndarray,
        joint_positions: np.ndarray,
        T_world_left: np.ndarray | None,
        T_world_right: np.ndarray | None,
        previous: np.ndarray,
        dt: float = 0.1,
    ) -> IKSolution:
        """Return the command that brings the palms to their targets, or as near as one step of `dt` gets.

        Args:
            T_world_pelvis: Measured pose of the pelvis, (4, 4).
            joint_positions: Measured, in `g1.BODY_JOINTS` order, (29,) [rad].
            T_world_left: Target of ``left_palm``, (4, 4); None keeps the previous arm.
            T_world_right: Target of ``right_palm``, likewise.
            previous: The command before, (23,); changes are limited to the rates of the settings times `dt`.
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
        lower, upper = self._window(previous, dt)
        solution = previous.copy()
        solution[command.VELOCITY] = 0.0

        columns = _TORSO_COLUMNS + _ARM_COLUMNS
        planned = self._torso_pass.solve(
            _heading(T_world_pelvis), previous[columns], lower[columns], upper[columns], targets
        )
        if any(target is not None for target in targets):
            solution[_TORSO_COLUMNS] = planned[: len(_TORSO_COLUMNS)]
        planned_error, _ = self._torso_pass.errors(targets)

        T_world_torso = T_world_pelvis @ self._pelvis_to_torso(joint_positions)
        arms = self._arm_pass.solve(
            T_world_torso, previous[_ARM_COLUMNS], lower[_ARM_COLUMNS], upper[_ARM_COLUMNS], targets
        )
        solution[_ARM_COLUMNS] = arms
        for arm, target in zip(_ARMS, targets, strict=True):
            if target is None:
                solution[arm] = previous[arm]
        position_error, orientation_error = self._arm_pass.errors(targets)
        return IKSolution(
            command=solution,
            position_error=position_error,
            orientation_error=orientation_error,
            planned_position_error=planned_error,
        )

    def _window(self, previous: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds of the next command, (23,) each: its own bounds met with what the rates allow."""
        step = np.zeros(command.SIZE)
        step[command.TORSO] = self.settings.torso_rate * dt
        step[command.HEIGHT] = self.settings.height_rate * dt
        step[command.ARMS] = self.settings.arm_rate * dt
        return np.maximum(command.LOWER, previous - step), np.minimum(command.UPPER, previous + step)

    def _pelvis_to_torso(self, joint_positions: np.ndarray) -> np.ndarray:
        """Return the torso's pose in the pelvis frame, (4, 4)."""
        self._data.qpos[self._qpos] = joint_positions
        mujoco.mj_kinematics(self._model, self._data)
        T_world_pelvis, T_world_torso = np.eye(4), np.eye(4)
        for T, body in ((T_world_pelvis, self._pelvis), (T_world_torso, self._torso)):
            T[:3, :3], T[:3, 3] = self._data.xmat[body].reshape(3, 3), self._data.xpos[body]
        R_pelvis_world = T_world_pelvis[:3, :3].T
        T_pelvis_torso = np.eye(4)
        T_pelvis_torso[:3, :3] = R_pelvis_world @ T_world_torso[:3, :3]
        T_pelvis_torso[:3, 3] = R_pelvis_world @ (T_world_torso[:3, 3] - T_world_pelvis[:3, 3])
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


def _heading(T_world_pelvis: np.ndarray) -> np.ndarray:
    """Return the frame on the floor below the pelvis, turned with it about the vertical, (4, 4)."""
    yaw = np.arctan2(T_world_pelvis[1, 0], T_world_pelvis[0, 0])
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
