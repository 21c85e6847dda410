"""A command -> the G1 as it stands when it obeys the command exactly: its palms, and whether it touches itself."""

import mujoco
import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import command, features, gait_clock, reference
from gym_demohlm.robot import g1


class Figure:
    """The robot as it stands when it obeys a command exactly.

    Args:
        model: Any model that contains the robot.
        pose: The controller's reference.
    """

    def __init__(self, model: mujoco.MjModel, pose: reference.Reference) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self._reference = pose
        self._joints = np.array([int(model.joint(f"{joint}_joint").qposadr[0]) for joint in g1.BODY_JOINTS])
        self._base = int(model.joint(model.body("pelvis").jntadr[0]).qposadr[0])
        self._soles = {index for index in range(model.ngeom) if "foot_point" in model.geom(index).name}

    def stand(self, wanted: np.ndarray) -> np.ndarray:
        """Obey a command (23,) with the soles' middle at the origin; return the palms' poses, (2, 4, 4)."""
        data, base = self.data, self._base
        at_rest = gait_clock.at_rest(1), np.zeros((1, 2))
        arms = wanted[command.ARMS]
        moment = self._reference.arms_moment(wanted[None], arms[None, features.OBSERVED_ARM_INDEX], np.zeros((1, 2)))
        data.qpos[self._joints] = np.concatenate([self._reference.pose(wanted[None], *at_rest, moment)[0], arms])
        data.qpos[base : base + 7] = [0, 0, 0, 1, 0, 0, 0]
        mujoco.mj_kinematics(self.model, data)
        tilt = poses.rpy(data.site("left_sole").xmat.reshape(3, 3).T) * [1, 1, 0]  # the sole is level
        R_world_pelvis = poses.rotation_from_rpy(tilt)
        soles = np.mean([R_world_pelvis @ data.site(f"{side}_sole").xpos for side in g1.SIDES], axis=0)
        data.qpos[base : base + 3] = [-soles[0], -soles[1], wanted[command.HEIGHT]]
        data.qpos[base + 3 : base + 7] = poses.matrix_to_quat(R_world_pelvis)
        mujoco.mj_kinematics(self.model, data)
        palms = [data.site(f"{side}_palm") for side in g1.SIDES]
        return np.stack([poses.from_rotation(palm.xmat.reshape(3, 3), palm.xpos) for palm in palms])

    def pelvis(self) -> np.ndarray:
        """Return the position of the pelvis, (3,) [m]."""
        return self.data.qpos[self._base : self._base + 3].copy()

    def collides(self) -> bool:
        """Return whether anything but the soles touches anything."""
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        return any(not self._soles & {contact.geom1, contact.geom2} for contact in self.data.contact)
