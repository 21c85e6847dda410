"""Where furniture is -> a place to stand that is clear of it, and a point on a way around it.

Where things are scattered, a place that is about one object may be too near to the table that it lies on, and the
straight way to another table may lead through either of them. Points are (2,), on the floor [m].
"""

import math

import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import dot, norm

TOLERANCE_M = 0.02  # by which a place may be nearer than the demonstrated one
_WIDEST_BEND = math.radians(120.0)  # of a way with one point between its ends


def stand_clear(goal: np.ndarray, centre: np.ndarray, distance_m: float) -> np.ndarray:
    """Return a base goal (3,) x, y, yaw [m, m, rad], moved straight back until it is as far from something before it.

    Args:
        goal: (3,).
        centre: (2,) of the thing; it stays as it is if that is behind, or aside by more than the distance.
        distance_m: Least distance from the centre [m].
    """
    ahead = poses.planar(*goal)[:2, 0]
    offset = centre - goal[:2]
    forward, across = float(dot(offset, ahead)), float(dot(offset, np.array([-ahead[1], ahead[0]])))
    if forward <= 0.0 or abs(across) >= distance_m:
        return goal
    back = math.sqrt(distance_m**2 - across**2) - forward
    return goal if back <= 0.0 else np.append(goal[:2] - back * ahead, goal[2])


def way_around(start: np.ndarray, goal: np.ndarray, obstacle: np.ndarray, clearance_m: float) -> np.ndarray | None:
    """Return the point (2,) at which a way around a round obstacle bends; None where the straight way is clear.

    It is where the tangents from both ends to the circle of the clearance meet. Where an end lies inside the
    clearance, the clearance shrinks to it.

    Args:
        start: (2,).
        goal: (2,).
        obstacle: (2,).
        clearance_m: Distance to keep from the obstacle's middle [m].
    """
    to_start, to_goal = start - obstacle, goal - obstacle
    distances = float(norm(to_start)), float(norm(to_goal))
    radius = min(clearance_m, *distances)
    if radius <= 0.0:
        return None
    angles = [math.atan2(end[1], end[0]) for end in (to_start, to_goal)]
    between = float(poses.wrap_angle(angles[1] - angles[0]))
    side = math.copysign(1.0, between)
    reach = [math.acos(radius / distance) for distance in distances]  # from an end to where its tangent touches
    arc = abs(between) - sum(reach)
    if arc <= 0.0:
        return None
    middle = angles[0] + side * (reach[0] + arc / 2)
    outwards = radius / math.cos(min(arc, _WIDEST_BEND) / 2)
    return obstacle + outwards * np.array([math.cos(middle), math.sin(middle)])
