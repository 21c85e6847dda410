"""Depth and masks, frame by frame -> the poses of all objects of a task: what one of them tells of another is used.

A tracker alone does not know that an object's front faces the robot, that an object lies on a carrier, that furniture
stands behind its door, or what hides what. These say where a fit begins, and which of the poses that look alike is
meant.
"""

import math
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception.camera import Intrinsics, Window
from gym_demohlm.perception.meshes import ObjectMesh
from gym_demohlm.perception.tracker import Tracker

_NEAR_HAND = 0.22  # m, palm to a corner of an object that it may move


class ObjectTrackers:
    """Follows objects that stand in one scene.

    Args:
        meshes: Their shapes; what comes first is handled on, in or before what follows.
        intrinsics: Of the images, as far as the robot knows them.
        doors: What stands behind which door, see ``doors``.

    Attributes:
        trackers: One an object.
        touched: Numbers of the objects that a hand was near: they may lie otherwise than at first.
    """

    def __init__(
        self, meshes: Sequence[ObjectMesh], intrinsics: Intrinsics, doors: Mapping[int, tuple[int, np.ndarray]]
    ) -> None:
        self.trackers = [Tracker(mesh, intrinsics) for mesh in meshes]
        self.touched: set[int] = set()
        self._specs, self._doors = [mesh.spec for mesh in meshes], doors

    def update(
        self,
        depth: np.ndarray,
        found: Mapping[int, np.ndarray],
        window: Window,
        T_odom_optical: np.ndarray,
        dt_s: float,
        *,
        hands_before: Mapping[str, np.ndarray],
        hands: Mapping[str, np.ndarray],
        robot: np.ndarray,
    ) -> None:
        """Look at a frame.

        Args:
            depth: (height, width) float32 of the window [m], 0 where nothing was measured.
            found: By the number of each object that is looked at, its pixels (height, width) bool of the window.
            window: Part of the image.
            T_odom_optical: The camera's pose (4, 4) in odometry coordinates, z up.
            dt_s: Time since the last frame [s].
            hands_before: Palms (4, 4) by side in odometry coordinates, in the last frame; empty where they are not
                known: then no object counts as touched.
            hands: The same in this frame.
            robot: (height, width) bool of the window, the robot's own pixels.
        """
        hiders, in_front = robot, {}
        for k in found:
            in_front[k] = hiders
            hiders = hiders | found[k]
        for k in sorted(found, key=lambda k: self._specs[k].moves_with is not None):
            tracker, motions = self.trackers[k], _hand_motions(self.trackers[k], hands_before, hands)
            if motions:
                self.touched.add(k)
            carried = self._carried(k)
            lies = self._faces(k, T_odom_optical, found[k], window) if carried is None else carried
            tracker.update(depth, found[k], window, T_odom_optical, dt_s, motions, in_front[k], lies, self._expected(k))
            if carried is not None and k not in self.touched:
                tracker.settle(T_odom_optical, carried)

    def _carried(self, k: int) -> np.ndarray | None:
        """Return how (3, 3) an object lies on what carries it, in odometry coordinates; None before that was seen."""
        entry = self._specs[k]
        names = [spec.name for spec in self._specs]
        if entry.moves_with not in names:
            return None
        carrier = names.index(entry.moves_with)
        track = self.trackers[carrier].track
        if track is None:
            return None
        turn = entry.yaw - self._specs[carrier].yaw
        return track.T_odom_object[:3, :3] @ poses.planar(0.0, 0.0, turn)[:3, :3]

    def _expected(self, k: int) -> np.ndarray | None:
        """Return where (4, 4) furniture stands by its door, in odometry coordinates; None for any place.

        A door that nobody has touched is closed.
        """
        if k not in self._doors:
            return None
        door, T_door_object = self._doors[k]
        track = self.trackers[door].track
        if track is None or not track.valid or door in self.touched:
            return None
        return track.T_odom_object @ T_door_object

    def _faces(self, k: int, T_odom_optical: np.ndarray, mask: np.ndarray, window: Window) -> np.ndarray | None:
        """Return roughly how (3, 3) an object lies, in odometry coordinates, as its front is seen.

        None for any yaw, and where the tracker knows better.
        """
        entry, tracker = self._specs[k], self.trackers[k]
        if tracker.was_whole or entry.symmetry != (0.0,) or not mask.any():
            return None
        by_column, by_row = np.count_nonzero(mask, axis=0), np.count_nonzero(mask, axis=1)
        middle = np.array([by_column @ np.arange(len(by_column)), by_row @ np.arange(len(by_row))]) / by_row.sum()
        middle = middle + window.corner
        sight = T_odom_optical[:3, :3] @ tracker.intrinsics.unproject(middle, np.array(1.0))
        return poses.planar(0.0, 0.0, math.atan2(sight[1], sight[0]) + entry.yaw)[:3, :3]


def doors(model: mujoco.MjModel, meshes: Sequence[ObjectMesh]) -> dict[int, tuple[int, np.ndarray]]:
    """Return the door of each piece of furniture that has one among the tracked objects.

    Args:
        model: Of the scene.
        meshes: Of its tracked objects.

    Returns:
        By the furniture's number, the door's, and where (4, 4) the furniture is from the door that is closed.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    bodies = [model.body(mesh.name).id for mesh in meshes]
    T_world = [poses.pose(data.xpos[body], data.xquat[body]) for body in bodies]
    found = {}
    for door, body in enumerate(bodies):
        above = int(model.body_parentid[body])
        while above > 0:
            for k, mesh in enumerate(meshes):
                if mesh.fixed and bodies[k] == above:
                    found[k] = door, poses.invert(T_world[door]) @ T_world[k]
            above = int(model.body_parentid[above])
    return found


def _hand_motions(
    tracker: Tracker, before: Mapping[str, np.ndarray], now: Mapping[str, np.ndarray]
) -> list[np.ndarray]:
    """Return the motions since the last frame of the palms near an object."""
    if tracker.track is None or not before:
        return []
    corners = poses.transform(tracker.track.T_odom_object, tracker.shape.vertices)
    both = [side for side in now if side in before]
    near = [side for side in both if np.linalg.norm(corners - before[side][:3, 3], axis=1).min() < _NEAR_HAND]
    return [now[side] @ poses.invert(before[side]) for side in near]
