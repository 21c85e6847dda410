"""The state of N worlds of one task -> poses, joint readings, forces, success: whatever is asked about them.

Every answer is a copy with one row a world. ``Simulation`` moves these worlds.
"""

import math

import mujoco
import numpy as np

from gym_demohlm.control import command
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.robot import g1
from gym_demohlm.robot.hands import GRIPPER
from gym_demohlm.robot.neck import NECK_JOINTS
from gym_demohlm.robot.physics import Physics
from gym_demohlm.scene import build_scene
from gym_demohlm.simulation.judge import FALLEN_HEIGHT, FALLEN_TILT
from gym_demohlm.task import Task
from gym_demohlm.variation import NONE, Conditions, Variation

JAW_MARGIN = 0.002  # m: jaws this near to closed hold nothing
STATE_SPEC = mujoco.mjtState.mjSTATE_FULLPHYSICS.value  # what a row of physics holds: time, qpos, qvel


class Worlds:
    """N worlds of one task at one moment.

    Args:
        task: The task.
        num_worlds: N.
        physics: Of the robots; that of scenes without a controller by default.
        variation: What may differ from world to world.

    Attributes:
        task: The task.
        scene: Its scene, shared by all worlds.
        model: The scene's compiled model.
        num_worlds: N.
    """

    def __init__(
        self, task: Task, num_worlds: int, physics: Physics | None = None, variation: Variation = NONE
    ) -> None:
        self.task = task
        self.scene = build_scene(task, physics, variation)
        self._conditions = [Conditions()] * num_worlds
        self.model = model = self.scene.model
        self.num_worlds = num_worlds
        self._physics = np.zeros((num_worlds, mujoco.mj_stateSize(model, STATE_SPEC)))
        self._velocities = slice(1 + model.nq, 1 + model.nq + model.nv)
        self._qpos, self._qvel = self._physics[:, 1 : 1 + model.nq], self._physics[:, self._velocities]  # views
        self._mocap = np.zeros((num_worlds, 7 * model.nmocap))  # all positions, then all quaternions
        self._command = np.zeros((num_worlds, command.SIZE))
        self._neck = np.zeros((num_worlds, len(NECK_JOINTS)))  # rad, the neck's targets
        self._forces = np.zeros((num_worlds, len(task.contact_pairs) + len(task.force_pairs)))
        self._collisions = np.zeros(num_worlds)
        self._unstable = np.zeros(num_worlds, dtype=bool)
        self._memory = np.zeros((num_worlds, 0 if task.memory is None else task.memory.size))
        self._start_poses = np.zeros((num_worlds, len(task.objects), 4, 4))
        self._scratch = mujoco.MjData(model)
        self._frames = {
            "body": np.tile(np.eye(4), (num_worlds, model.nbody, 1, 1)),
            "site": np.tile(np.eye(4), (num_worlds, model.nsite, 1, 1)),
        }
        self._stale = np.zeros(num_worlds, dtype=bool)  # worlds whose frames are older than their state

    @property
    def qpos(self) -> np.ndarray:
        """(N, nq) generalised positions."""
        return self._qpos.copy()

    @property
    def qvel(self) -> np.ndarray:
        """(N, nv) generalised velocities."""
        return self._qvel.copy()

    @property
    def time(self) -> np.ndarray:
        """(N,) since the reset [s]."""
        return self._physics[:, 0].copy()

    @property
    def command(self) -> np.ndarray:
        """(N, 23) the last command applied."""
        return self._command.copy()

    @property
    def unstable(self) -> np.ndarray:
        """(N,) whether the physics broke down since the reset."""
        return self._unstable.copy()

    def joint_position(self, name: str) -> np.ndarray:
        """Return the position (N,) of a hinge or slide joint, by its name in the model [rad or m].

        Raises:
            UnknownNameError: The model has no such joint.
        """
        return self._qpos[:, self._joint_addresses(name)[0]].copy()

    def joint_velocity(self, name: str) -> np.ndarray:
        """Return the velocity (N,) of a hinge or slide joint, by its name in the model [rad/s or m/s].

        Raises:
            UnknownNameError: The model has no such joint.
        """
        return self._qvel[:, self._joint_addresses(name)[1]].copy()

    def velocity(self, name: str) -> np.ndarray:
        """Return the velocity (N, 6) of a body with a free joint, such as "pelvis" or an object.

        The first three numbers are linear, in the world [m/s]; the others angular, in the body's own frame [rad/s].

        Raises:
            UnknownNameError: The model has no such frame.
            SceneError: The body has no free joint.
        """
        _, first = self._free_addresses(name)
        return self._qvel[:, first : first + 6].copy()

    @property
    def joint_positions(self) -> np.ndarray:
        """(N, 29) of the body joints, g1.BODY_JOINTS order [rad]."""
        return self._qpos[:, self.scene.body_qpos]

    @property
    def joint_velocities(self) -> np.ndarray:
        """(N, 29) of the body joints [rad/s]."""
        return self._qvel[:, self.scene.body_qvel]

    def sensed_joints(self) -> tuple[np.ndarray, np.ndarray]:
        """Return positions [rad] and velocities [rad/s] of the body joints as the encoders read them, (N, 29) each."""
        return self.joint_positions, self.joint_velocities

    def conditions(self, world: int = 0) -> Conditions:
        """Return how a world differs from the plain one."""
        return self._conditions[world]

    @property
    def neck_positions(self) -> np.ndarray:
        """(N, 2) neck yaw and pitch [rad]."""
        return self._qpos[:, self.scene.neck_qpos]

    @property
    def neck_velocities(self) -> np.ndarray:
        """(N, 2) of neck yaw and pitch [rad/s]."""
        return self._qvel[:, self.scene.neck_qvel]

    @property
    def gripper_positions(self) -> np.ndarray:
        """(N, 2) travel of the left and right gripper jaw from open [m]; zero with rubber hands."""
        return self._qpos[:, self.scene.jaw_qpos] if len(self.scene.jaw_qpos) else np.zeros((self.num_worlds, 2))

    @property
    def gripper_velocities(self) -> np.ndarray:
        """(N, 2) of the gripper jaws [m/s]; zero with rubber hands."""
        return self._qvel[:, self.scene.jaw_qvel] if len(self.scene.jaw_qvel) else np.zeros((self.num_worlds, 2))

    @property
    def base_quat_wxyz(self) -> np.ndarray:
        """(N, 4) orientation of the pelvis in the world."""
        start = self.scene.base_qpos + 3
        return self._qpos[:, start : start + 4].copy()

    @property
    def gyro(self) -> np.ndarray:
        """(N, 3) angular velocity of the pelvis in its own frame [rad/s]."""
        start = self.scene.base_qvel + 3
        return self._qvel[:, start : start + 3].copy()

    def proprioception(self, worlds: np.ndarray | slice | None = None) -> Proprioception:
        """Return what the robots of some worlds sense, all by default; one row a world."""
        scene, rows = self.scene, slice(None) if worlds is None else worlds
        qpos, qvel = self._qpos[rows], self._qvel[rows]
        quat, gyro = scene.base_qpos + 3, scene.base_qvel + 3
        return Proprioception(
            quat_wxyz=qpos[:, quat : quat + 4],
            gyro=qvel[:, gyro : gyro + 3],
            q=qpos[:, scene.body_qpos],
            dq=qvel[:, scene.body_qvel],
        )

    def pose(self, name: str) -> np.ndarray:
        """Return the pose (N, 4, 4) in the world of a frame: "pelvis", "torso", "left_palm", any object, body or site.

        Raises:
            UnknownNameError: There is no such frame.
        """
        kind, index = self.scene.frame(name)
        self._refresh_frames()
        return self._frames[kind][:, index].copy()

    def start_pose(self, name: str) -> np.ndarray:
        """Return the pose (N, 4, 4) in the world at which a tracked object was put at the reset."""
        self.task.object(name)
        return self._start_poses[:, [entry.name for entry in self.task.objects].index(name)].copy()

    def distance(self, first: str, second: str) -> np.ndarray:
        """Return the distance (N,) between the origins of two frames [m]."""
        offset = self.pose(first)[:, :3, 3] - self.pose(second)[:, :3, 3]
        return np.sqrt((offset**2).sum(axis=1))

    def contact_force(self, side: str, name: str) -> np.ndarray:
        """Return the normal force (N,) between a hand and an object, mean over the last tick [N].

        Raises:
            UnknownNameError: The task measures no such pair.
        """
        return self._force("contact pair", self.task.contact_pairs, (side, name), 0)

    def pair_force(self, first: str, second: str) -> np.ndarray:
        """Return the normal force (N,) between two bodies of ``task.force_pairs``, mean over the last tick [N].

        Raises:
            UnknownNameError: The task measures no such pair.
        """
        return self._force("force pair", self.task.force_pairs, (first, second), len(self.task.contact_pairs))

    def _force(self, kind: str, pairs: tuple[tuple[str, str], ...], pair: tuple[str, str], column: int) -> np.ndarray:
        """Return the force (N,) of one of the pairs whose forces begin at a column [N]."""
        if pair not in pairs:
            raise UnknownNameError(kind, ", ".join(pair), [", ".join(known) for known in pairs])
        return self._forces[:, column + pairs.index(pair)].copy()

    def holds(self, side: str, name: str, force_n: float = 2.0) -> np.ndarray:
        """Return whether a gripper (N,) is commanded to close, presses on an object and cannot close because of it.

        Args:
            side: "left" or "right".
            name: The object; the task measures that pair.
            force_n: Least normal force on it [N].
        """
        index = g1.SIDES.index(side)
        closing = self._command[:, command.GRIPPERS][:, index] > 0.5
        kept_open = self.gripper_positions[:, index] < GRIPPER.stroke - JAW_MARGIN
        return closing & kept_open & (self.contact_force(side, name) >= force_n)

    @property
    def memory(self) -> np.ndarray:
        """(N, size) what the task remembers of each world, see ``Task.memory``."""
        return self._memory.copy()

    @property
    def collision_force(self) -> np.ndarray:
        """(N,) largest normal force between robot and obstacles in the last tick [N]."""
        return self._collisions.copy()

    def fallen(self) -> np.ndarray:
        """Return whether the robot has fallen (N,): pelvis low or tilted."""
        _, x, y, _ = self.base_quat_wxyz.T
        upright = 1.0 - 2.0 * (x * x + y * y)  # cosine of the tilt
        height = self._qpos[:, self.scene.base_qpos + 2]
        return (height < FALLEN_HEIGHT) | (upright < math.cos(FALLEN_TILT))

    def success(self) -> np.ndarray:
        """Return whether the task's success condition holds now (N,)."""
        return np.asarray(self.task.success(self), dtype=bool)

    def failures(self) -> dict[str, np.ndarray]:
        """Return the task's failure predicates, each (N,)."""
        return {name: np.asarray(predicate(self), dtype=bool) for name, predicate in self.task.failures.items()}

    def mj_data(self, world: int = 0) -> mujoco.MjData:
        """Return MuJoCo's data of a world for drawing, kinematics done; it changes at the next call."""
        if self.scene.variation:
            self.scene.dress(self._conditions[world])
        self._load(world)
        mujoco.mj_fwdPosition(self.model, self._scratch)
        if self.task.memory is not None:
            self.task.memory.draw(self.model, self._memory[world])
        return self._scratch

    def _free_addresses(self, name: str) -> tuple[int, int]:
        """Return where position and velocity of a body's free joint begin in qpos and qvel."""
        kind, index = self.scene.frame(name)
        joint = int(self.model.body_jntadr[index]) if kind == "body" else -1
        if joint < 0 or self.model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            raise SceneError(f"{name!r}, which has no free joint", "a body that moves freely", "name the whole object")
        return int(self.model.jnt_qposadr[joint]), int(self.model.jnt_dofadr[joint])

    def _joint_addresses(self, name: str) -> tuple[int, int]:
        """Return the addresses of a hinge or slide joint in qpos and qvel."""
        model = self.model
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
        single = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        if index < 0 or model.jnt_type[index] not in single:
            known = [model.joint(i).name for i in range(model.njnt) if model.jnt_type[i] in single]
            raise UnknownNameError("hinge or slide joint", name, known)
        return int(model.jnt_qposadr[index]), int(model.jnt_dofadr[index])

    def _refresh_frames(self) -> None:
        if not self._stale.any():
            return
        scratch, bodies, sites = self._scratch, self._frames["body"], self._frames["site"]
        for world in np.flatnonzero(self._stale):
            self._load(world)
            mujoco.mj_kinematics(self.model, scratch)
            bodies[world, :, :3, 3], bodies[world, :, :3, :3] = scratch.xpos, scratch.xmat.reshape(-1, 3, 3)
            sites[world, :, :3, 3], sites[world, :, :3, :3] = scratch.site_xpos, scratch.site_xmat.reshape(-1, 3, 3)
        self._stale[:] = False

    def _load(self, world: int) -> None:
        mujoco.mj_setState(self.model, self._scratch, self._physics[world], STATE_SPEC)
        split = 3 * self.model.nmocap
        self._scratch.mocap_pos[:] = self._mocap[world, :split].reshape(-1, 3)
        self._scratch.mocap_quat[:] = self._mocap[world, split:].reshape(-1, 4)
