"""Joints and attitude of a robot -> where it is: counted from the foot that stands, without physics.

The frame ``odometry`` has its z axis up, its floor at z = 0 and its heading from the robot's IMU. It slides over the
true floor as soles roll and slip, by some per cent of the way. So it tells well how the robot has moved between a
picture and now, and not where in a room it stands.
"""

import mujoco
import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception.camera import torso_camera
from gym_demohlm.robot import g1
from gym_demohlm.robot.robot import robot_spec

_STEP_M = 0.001  # m that a sole must be below the other to take over as the one that stands


class LegOdometry:
    """Follows a robot from measurement to measurement."""

    def __init__(self) -> None:
        self._model = robot_spec("rubber").compile()  # hands do not matter
        self._data = mujoco.MjData(self._model)
        self._qpos = [int(self._model.joint(f"{name}_joint").qposadr[0]) for name in g1.BODY_JOINTS]
        self._soles = [self._model.site(f"{side}_sole").id for side in g1.SIDES]
        self._bodies = [self._model.body(name).id for name in ("pelvis", "torso_link")]
        self._p_pelvis = np.zeros(3)
        self._support: int | None = None

    def update(self, q: np.ndarray, quat_wxyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Take in a measurement; returns where pelvis and torso are, (4, 4) each in the frame ``odometry``.

        Args:
            q: (29,) joint positions [rad].
            quat_wxyz: (4,) orientation of the pelvis.
        """
        self._data.qpos[:3], self._data.qpos[3:7] = 0.0, quat_wxyz
        self._data.qpos[self._qpos] = q
        mujoco.mj_kinematics(self._model, self._data)
        soles = self._data.site_xpos[self._soles]  # (2, 3) as seen from the pelvis
        lower = int(np.argmin(soles[:, 2]))
        if self._support is None:
            self._support, self._anchor = lower, soles[lower, :2].copy()
        self._p_pelvis = np.append(self._anchor - soles[self._support, :2], -soles[lower, 2])
        if soles[lower, 2] < soles[self._support, 2] - _STEP_M:
            self._support, self._anchor = lower, (self._p_pelvis + soles[lower])[:2]
        pelvis, torso = (self._pose(body) for body in self._bodies)
        return pelvis, torso

    def _pose(self, body: int) -> np.ndarray:
        return poses.from_rotation(self._data.xmat[body].reshape(3, 3), self._p_pelvis + self._data.xpos[body])


def odometry_camera(state: np.void, servos: np.void | None) -> np.ndarray:
    """Return ``T_odometry_camera`` (4, 4), where the head camera is.

    Args:
        state: A record "state".
        servos: A record "servos"; a neck at zero without one.
    """
    return state["T_odometry_torso"] @ torso_camera(np.zeros(2) if servos is None else servos["neck"])
