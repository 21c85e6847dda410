"""Waiting, and what a robot tells of itself, for tests of the way to the robot."""

import time
from collections.abc import Callable

import numpy as np

from gym_demohlm import poses
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from lerobot_demohlm.hardware import records
from lerobot_demohlm.hardware.odometry import LegOdometry, odometry_camera
from lerobot_demohlm.hardware.slots import Reading


def until(condition: Callable[[], bool], timeout_s: float, pause_s: float = 0.005) -> None:
    """Wait until a condition holds.

    Raises:
        AssertionError: It does not within the time.
    """
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, f"{condition} did not come true within {timeout_s} s"
        time.sleep(pause_s)


class Told:
    """A simulated robot, and what it tells of itself: nothing of where it is."""

    def __init__(self, task: str, dz: float = 0.0) -> None:
        self.sim = Simulation(get_task(task))
        self.sim.reset([self.sim.task.default_state() | {"object": [0.0, dz, 0.0]}])
        self.hidden: tuple[str, ...] = ()
        self._odometry = LegOdometry()

    def read(self, name: str) -> Reading | None:
        """Return the newest value of a record."""
        value = {"state": self._state, "servos": self._servos, "pose": self._pose}[name]()
        return Reading(value=value, number=1, time_ns=time.monotonic_ns())

    def _state(self) -> np.void:
        # An IMU's heading is from wherever it was switched on.
        turned = poses.planar(0.0, 0.0, 1.0) @ self.sim.pose("pelvis")[0]
        q, quat_wxyz = self.sim.joint_positions[0], poses.split(turned)[1]
        pelvis, torso = self._odometry.update(q, quat_wxyz)
        return records.record("state", q=q, quat_wxyz=quat_wxyz, T_odometry_pelvis=pelvis, T_odometry_torso=torso)

    def _servos(self) -> np.void:
        return records.record("servos", neck=self.sim.neck_positions[0], jaws=self.sim.gripper_positions[0])

    def _pose(self) -> np.void:
        value = np.zeros((), records.RECORDS["pose"])
        value["T_odometry_camera"] = odometry_camera(self._state(), self._servos())
        T_camera_world = poses.invert(self.sim.pose("head_camera")[0])
        for index, entry in enumerate(self.sim.task.objects):
            value["T_camera_object"][index] = T_camera_world @ self.sim.pose(entry.name)[0]
            value["valid"][index] = entry.name not in self.hidden
        return value[()]  # pyright: ignore[reportReturnType]
