"""The target's position in the head camera -> new neck angles that bring it to the middle of the image.

The paper's proportional controller, section "Low-Level Whole-body Controller": angular velocities proportional to the
target's offset, clipped to a maximum, integrated to joint targets. Two mends. Axes: the paper writes ``-k y_c`` for
yaw and ``-k x_c`` for pitch without naming its camera axes; here the camera has x forward, y left, z up, yaw turns left
and pitch turns down, so a target on the left (y > 0) raises yaw and one above (z > 0) lowers pitch. Units: the offset
is the bearing [rad] instead of metres, so the speed of convergence does not depend on the distance.
"""

from dataclasses import dataclass

import numpy as np

from gym_demohlm.arithmetic import arctan2, hypot
from gym_demohlm.robot.neck import NECK_LOWER, NECK_UPPER


@dataclass(frozen=True, kw_only=True)
class GazeController:
    """A proportional controller of yaw and pitch; it remembers nothing, the angles are the state.

    Attributes:
        yaw_gain: [1/s].
        pitch_gain: [1/s].
        max_speed: Bound of both joint speeds [rad/s]; the servo reaches 8.5.
    """

    yaw_gain: float = 5.0
    pitch_gain: float = 5.0
    max_speed: float = 2.0

    def step(self, neck: np.ndarray, p_camera_target: np.ndarray, dt: float) -> np.ndarray:
        """Return the neck targets after `dt`.

        Args:
            neck: Present targets of yaw and pitch, (N, 2) [rad].
            p_camera_target: Position of the target in the frame ``head_camera``, (N, 3) [m].
            dt: [s].

        Returns:
            New targets inside the joint limits, (N, 2) [rad].
        """
        x, y, z = p_camera_target[:, 0], p_camera_target[:, 1], p_camera_target[:, 2]
        yaw_speed = np.clip(self.yaw_gain * arctan2(y, x), -self.max_speed, self.max_speed)
        pitch_speed = np.clip(-self.pitch_gain * arctan2(z, hypot(x, y)), -self.max_speed, self.max_speed)
        return np.clip(neck + np.stack([yaw_speed, pitch_speed], axis=1) * dt, NECK_LOWER, NECK_UPPER)
