"""What a robot at the other end of a network tells of itself -> a scene in which a teleoperator sees it.

A robot measures its joints and how it is tilted, not where it is. Here it stands on the foot that is lower, and what
it does is counted from there, see ``hardware.odometry``. Objects are where the pose source sees them.
"""

import math
import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gym_demohlm import poses
from gym_demohlm.envs import observation
from gym_demohlm.errors import SceneError
from gym_demohlm.robot import g1, neck
from gym_demohlm.robot.robot import GRIPPER_JOINTS
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from gym_demohlm.timing import CONTROL_DT, TICKS
from lerobot_demohlm.devices.live import Seen
from lerobot_demohlm.hardware import robot_observation
from lerobot_demohlm.hardware.slots import Reading
from lerobot_demohlm.teleop.realtime import RealTimeWorld
from lerobot_demohlm.teleop.recorder import scene_view


class Mirror:
    """A simulated robot that takes every pose of a real one, 50 times a second, in a thread of its own.

    The world's frame is that of the task: an episode begins with the robot where the task has it by default. Tables are
    where they would be beside the first object that is seen; nothing measures them.

    Args:
        task: The task.
        read: Name of a record -> its newest value, see ``hardware.records``.

    Attributes:
        task: The task.
        sim: The scene; only its own thread may change it.
        pace: What shows its ticks.
        seen: The robot after the last step of 0.1 s. ``success`` is never true: nobody measures it.
        framed_s: See ``live.Operated``.
        stays: See ``live.Operated``.
    """

    stays = True

    def __init__(self, task: Task, read: Callable[[str], Reading | None]) -> None:
        self.task, self.sim, self._read = task, Simulation(task), read
        self.pace = RealTimeWorld(self.sim)
        self.framed_s = -math.inf
        self._episode, self._step, self._new = -1, 0, True
        self._lock, self._stop = threading.Lock(), threading.Event()
        self.reset()
        self._thread = threading.Thread(target=self._run, name="mirror", daemon=True)
        self._thread.start()

    def reset(self) -> Seen:
        """Begin an episode: the robot is where the task has it; returns what is seen there."""
        with self._lock:
            self._episode += 1
            self._step, self._new = 0, True
            self.sim.reset([self.task.default_state()])
            self._objects: dict[str, np.ndarray] = {}
            self._show()
            self.seen = self._look()
            return self.seen

    def close(self) -> None:
        """Stop."""
        self._stop.set()
        self._thread.join(5.0)
        self.sim.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            self.pace.wait()
            for tick in range(TICKS):
                with self._lock:
                    self._show()
                    self.pace.after_tick(tick)
                if self._stop.wait(CONTROL_DT if tick < TICKS - 1 else 0.0):
                    return
            with self._lock:
                self._step += 1
                self.seen = self._look()

    def _look(self) -> Seen:
        view, state = scene_view(self.sim, self._step), self._read("state")
        servos, pose = self._read("servos"), self._read("pose")
        sensed = np.zeros(len(observation.STATE_NAMES), np.float32)
        objects = np.zeros(9 * len(self.task.objects), np.float32)
        if state is not None:
            neck_and_jaws = None if servos is None else servos.value
            sensed = robot_observation.agent_pos(state.value, neck_and_jaws)
            if pose is not None:
                count = len(self.task.objects)
                objects = robot_observation.environment_state(pose.value, state.value, neck_and_jaws, count)
        return Seen(
            episode=self._episode,
            step=self._step,
            view=replace(view, T_world_objects={**view.T_world_objects, **self._objects}),
            state=sensed,
            environment_state=objects,
            joint_positions=self.sim.joint_positions[0],
            success=False,
        )

    def _show(self) -> None:
        """Take the robot's pose, and put objects where they are seen."""
        state = self._read("state")
        if state is None:
            return
        servos = self._read("servos")
        for joint, angle in zip(g1.BODY_JOINTS, state.value["q"], strict=True):
            self.sim.set_joint(f"{joint}_joint", float(angle))
        if servos is not None:
            jaws = GRIPPER_JOINTS if self.sim.scene.num_grippers else ()
            places = [*servos.value["neck"], *servos.value["jaws"][: len(jaws)]]
            for joint, place in zip((*neck.NECK_JOINTS, *jaws), places, strict=True):
                self.sim.set_joint(f"{joint}_joint", float(place))
        self._stand(state.value["T_odometry_pelvis"])
        pose = self._read("pose")
        if pose is not None:
            objects = robot_observation.objects(pose.value, state.value, None if servos is None else servos.value)
            self._see(objects, pose.value["valid"])

    def _stand(self, T_odometry_pelvis: np.ndarray) -> None:
        """Put the pelvis where odometry has it; an episode begins where the task has the robot."""
        if self._new:
            begun = poses.planar(*poses.to_planar(T_odometry_pelvis))
            self._T_world_odometry = poses.planar(*self.task.default_state()["robot"]) @ poses.invert(begun)
            self._new = False
        self.sim.set_pose("pelvis", self._T_world_odometry @ T_odometry_pelvis)

    def _see(self, T_camera_objects: np.ndarray, valid: np.ndarray) -> None:
        """Put objects where they are seen; what is not seen stays."""
        T_world_camera = self.sim.pose("head_camera")[0]
        for index, entry in enumerate(self.task.objects):
            if not valid[index]:
                continue
            T_world_object = T_world_camera @ T_camera_objects[index]
            if not self._objects:
                self._place_tables(T_world_object[:3, 3] - self.sim.pose(entry.name)[0, :3, 3])
            self._objects[entry.name] = T_world_object
            try:
                self.sim.set_pose(entry.name, T_world_object)
            except SceneError:
                continue  # it hangs on another: a handle on its door

    def _place_tables(self, offset: np.ndarray) -> None:
        """Move what objects stand on by how far (3,) [m] the first object is from where the task has it."""
        for support in set(self.task.supports) - {entry.name for entry in self.task.objects}:
            T_world_support = self.sim.pose(support)[0]
            T_world_support[:3, 3] += offset
            self.sim.set_pose(support, T_world_support)
