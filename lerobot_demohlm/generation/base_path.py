"""Where a demonstration walks while hands hold something -> velocities that take the base the same way from here.

A gait answers the same command with another speed when the torso bends lower or the hands push: repeated velocities
alone would end short. So each walk is followed as a path, from where the base was when it began.
"""

import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import dot, norm
from gym_demohlm.control import command
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.generation.stages import PlaybackSettings


class BasePath:
    """The walks of a demonstration, followed by one base.

    Args:
        demonstration: The source.
        settings: Gains and limits.
    """

    def __init__(self, demonstration: Demonstration, settings: PlaybackSettings) -> None:
        self._settings = settings
        self._base_d = poses.planar(*poses.to_planar(demonstration.T_world_pelvis).T)  # (T, 4, 4)
        self._velocity_d = demonstration.action[:, command.VELOCITY].astype(np.float64)  # (T, 3)
        self._walks = np.abs(self._velocity_d).max(axis=1) > 0.0
        self._motion = np.eye(4)  # from the demonstrated floor plane to this one, frozen when a walk begins

    def ends(self, tick: int) -> bool:
        """Return whether a walk ends with this tick."""
        return bool(self._walks[tick]) and (tick + 1 == len(self._walks) or not self._walks[tick + 1])

    def velocity(self, tick: int, T_world_pelvis: np.ndarray) -> np.ndarray:
        """Return the velocity command (3,) of a tick [m/s, m/s, rad/s]; zero where the demonstration stands.

        Args:
            tick: Of the demonstration.
            T_world_pelvis: (4, 4) now.
        """
        if not self._walks[tick]:
            return np.zeros(3)
        if tick == 0 or not self._walks[tick - 1]:
            here = poses.planar(*poses.to_planar(T_world_pelvis))
            self._motion = here @ poses.invert(self._base_d[tick])
        limit = np.array(self._settings.max_path_velocity)
        correction = np.array(self._settings.path_gain) * self._error(tick, T_world_pelvis)
        return self._velocity_d[tick] + np.clip(correction, -limit, limit)

    def remaining_velocity(self, tick: int, T_world_pelvis: np.ndarray) -> np.ndarray | None:
        """Return the velocity (3,) that makes up for what is left of a walk that ends with a tick; None if nothing."""
        error = self._error(tick, T_world_pelvis)
        ahead = self._velocity_d[tick, :2] / max(float(norm(self._velocity_d[tick, :2])), 1e-9)
        if float(dot(ahead, error[:2])) < self._settings.arrive_m:
            return None
        limit = np.array(self._settings.max_path_velocity)
        return self._velocity_d[tick] + np.clip(np.array(self._settings.path_gain) * error, -limit, limit)

    def _error(self, tick: int, T_world_pelvis: np.ndarray) -> np.ndarray:
        """Return how far (3,) the base is from its path, in its heading frame [m, m, rad]."""
        here = poses.planar(*poses.to_planar(T_world_pelvis))
        return poses.to_planar(poses.invert(here) @ self._motion @ self._base_d[tick])
