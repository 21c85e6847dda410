"""Hand poses of a demonstration -> hand targets and a base goal in a new scene: pure SE(3) arithmetic.

Notation: ``T_A_B`` is the pose of frame B in frame A; W world, O object, E end effector (a palm), R root (the pelvis);
a trailing ``d`` marks the demonstration, no mark is now. Time comes first in shapes, then the hand.

The paper's formulas taken literally do not adapt anything: ``(T_eef T_obj^-1) T_obj`` is ``T_eef``, and
``T_eef (T_pro)^-1`` plays the motion backwards (a lift by +0.1 m becomes one by -0.1 m). What is meant is written here.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import arctan2, dot, norm
from lerobot_demohlm.demonstrations.segments import Anchor

ANY_YAW_CANDIDATES = 72  # every 5 degrees, for a round object
TURN_WEIGHT = 0.4  # m/rad: what a radian of turning costs compared with a metre of walking
LAYOUT_WEIGHT = 20.0  # m/m: what another object a metre from where the motion expects it costs


def object_targets(T_W_Ed: np.ndarray, T_W_Od: np.ndarray, T_W_O: np.ndarray, symmetry: np.ndarray) -> np.ndarray:
    """Bring a demonstrated hand motion to where the object is now (pre-manipulation).

    ``X_t = inv(Td_W_O) Td_W_E[t]``, target ``T_W_E[t] = T_W_O S X_t``.

    Args:
        T_W_Ed: (..., 4, 4) demonstrated hand poses.
        T_W_Od: (4, 4) demonstrated object pose when the segment starts.
        T_W_O: (4, 4) object pose now, frozen when the segment starts.
        symmetry: (4, 4) a member S of the object's symmetry group, in the object frame.

    Returns:
        (..., 4, 4) hand targets in the world.
    """
    return scene_motion(T_W_Od, T_W_O, symmetry) @ T_W_Ed


def scene_motion(T_W_Od: np.ndarray, T_W_O: np.ndarray, symmetry: np.ndarray) -> np.ndarray:
    """Return T_W_O S inv(Td_W_O) (4, 4): the motion of the world that takes the demonstrated object to this one."""
    return T_W_O @ symmetry @ poses.invert(T_W_Od)


def base_goal(T_W_Rd: np.ndarray, T_W_Od: np.ndarray, T_W_O: np.ndarray, symmetry: np.ndarray) -> np.ndarray:
    """Return (x, y, yaw) [m, m, rad] from where the robot should act: the heading of T_W_O S inv(Td_W_O) Td_W_R."""
    return poses.to_planar(scene_motion(T_W_Od, T_W_O, symmetry) @ T_W_Rd)


def anchor_pose(kind: Anchor, T_W_E: np.ndarray, T_W_R: np.ndarray) -> np.ndarray:
    """Return the frames (hands, 4, 4) in which the motion of hands that act together is repeated.

    Args:
        kind: Which frame; "body" and "base" freeze none.
        T_W_E: (hands, 4, 4) last commanded targets of hands on one object. All kinds but "eef" share one frame, so
            that hands that moved as one rigid body in the demonstration do so again.
        T_W_R: (4, 4) root.
    """
    if kind == "eef":
        return T_W_E.copy()
    if kind == "root":
        shared = T_W_R
    else:
        yaw = poses.yaw(T_W_R) if kind == "eef_heading" else 0.0
        shared = poses.planar(0.0, 0.0, yaw)
        shared[:3, 3] = T_W_E[:, :3, 3].mean(axis=0)
    return np.broadcast_to(shared, T_W_E.shape).copy()


def anchored_targets(
    T_W_Ed: np.ndarray, last_d: np.ndarray, last: np.ndarray, anchor_d: np.ndarray, anchor: np.ndarray
) -> np.ndarray:
    """Repeat a demonstrated hand motion in a frame frozen at the switch c (manipulation).

    The motion since the switch, ``D_t = Td_W_E[t] inv(Td_W_E[c])``, is carried from the demonstrated anchor to the
    present one and applied to the last commanded target: ``T_W_E[t] = G D_t inv(G) T_W_E[c]``, ``G = A inv(Ad)``.
    Where the last target has the demonstrated relation to the anchor (``T_W_E[c] = G Td_W_E[c]``) this is
    ``A inv(Ad) Td_W_E[t]``; where it has not, because the robot stands a little differently, the targets are
    still continuous at c, and a squeeze, which is an offset of the last target, stays one.

    Args:
        T_W_Ed: (T, hands, 4, 4) demonstrated targets from the switch on.
        last_d: (hands, 4, 4) last demonstrated targets before the switch.
        last: (hands, 4, 4) last commanded targets before the switch, now.
        anchor_d: (hands, 4, 4) anchors in the demonstration.
        anchor: (hands, 4, 4) anchors now.

    Returns:
        (T, hands, 4, 4) targets in the world.
    """
    G = anchor @ poses.invert(anchor_d)
    D = T_W_Ed @ poses.invert(last_d)
    return G @ D @ (poses.invert(G) @ last)


def carried_targets(T_W_Ed: np.ndarray, T_W_Rd: np.ndarray, T_W_R: np.ndarray) -> np.ndarray:
    """Bring demonstrated hands to where the base is now, on the floor plane, to the places that they had on the robot.

    Args:
        T_W_Ed: (..., 4, 4) demonstrated targets.
        T_W_Rd: (4, 4) demonstrated root then.
        T_W_R: (4, 4) root now.

    Returns:
        (..., 4, 4) targets in the world.
    """
    return poses.planar(*poses.to_planar(T_W_R)) @ poses.invert(poses.planar(*poses.to_planar(T_W_Rd))) @ T_W_Ed


def transit(T_from: np.ndarray, T_to: np.ndarray, num_ticks: int) -> np.ndarray:
    """Return num_ticks poses (num_ticks, ..., 4, 4) that ease from T_from (excluded) to T_to (the last one).

    Position linear and rotation slerp, along a share that starts and ends at rest.
    """
    return poses.interpolate(T_from, T_to, _eased(num_ticks, T_from.ndim - 2))


def join(T_from: np.ndarray, T_path: np.ndarray, share: np.ndarray | None = None) -> np.ndarray:
    """Lead from a pose onto a path while it is followed: what parts them at its start is taken away along it.

    Args:
        T_from: (..., 4, 4) where the hands are.
        T_path: (T, ..., 4, 4) where they are to be, from now on; reached with the last pose.
        share: (T,) of that which is gone by then; by default it starts and ends at rest.

    Returns:
        (T, ..., 4, 4) the way of the hands.
    """
    if share is None:
        share = _eased(len(T_path), T_from.ndim - 2)
    share = share.reshape(-1, *[1] * (T_from.ndim - 2))
    joined = T_path.copy()
    joined[..., :3, 3] += (1.0 - share)[..., None] * (T_from - T_path[0])[..., :3, 3]
    apart = poses.from_rotation(T_from[..., :3, :3] @ np.swapaxes(T_path[0, ..., :3, :3], -1, -2))
    joined[..., :3, :3] = poses.interpolate(apart, np.eye(4), share)[..., :3, :3] @ T_path[..., :3, :3]
    return joined


def bring(T_from: np.ndarray, T_path: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Lead hands that hold something to places on the robot, two of them as one rigid body.

    Args:
        T_from: (hands, 4, 4) where they are.
        T_path: (T, hands, 4, 4) their way on the robot, beginning with where they are now.
        share: (T,) of what parts them from it that is gone by then, 0 at first.

    Returns:
        (T, hands, 4, 4) their way; what each is asked to press inwards, an offset from the others, stays.
    """
    way = _middle(T_path)
    led = join(_middle(T_from), way, share) @ poses.invert(way)  # (T, 4, 4)
    kept = poses.invert(led[0] @ T_path[0]) @ T_from
    return led[:, None] @ T_path @ kept


def _middle(T_hands: np.ndarray) -> np.ndarray:
    """Return one frame (..., 4, 4) of hands (..., n, 4, 4): that of one, or midway between two, facing across."""
    if T_hands.shape[-3] == 1:
        return T_hands[..., 0, :, :]
    across = (T_hands[..., 0, :3, 3] - T_hands[..., 1, :3, 3])[..., :2]
    frame = poses.planar(0.0, 0.0, arctan2(-across[..., 0], across[..., 1]))
    frame[..., :3, 3] = T_hands[..., :3, 3].mean(axis=-2)
    return frame


def progress(T_path: np.ndarray) -> np.ndarray:
    """Return the share (T,) of its way that a path (T, hands, 4, 4) has gone, as the furthest hand; 1 at rest."""
    steps = norm(np.diff(T_path[..., :3, 3], axis=0))  # (T - 1, hands)
    gone = np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)])
    furthest = gone[:, np.argmax(gone[-1])]
    return furthest / furthest[-1] if furthest[-1] > 0.0 else np.ones(len(T_path))


def _eased(num_ticks: int, dimensions: int) -> np.ndarray:
    """Return shares (num_ticks, 1, ...) of a way, the last one 1, that start and end at rest."""
    u = np.arange(1, num_ticks + 1) / max(num_ticks, 1)
    return (u * u * (3.0 - 2.0 * u)).reshape(-1, *[1] * dimensions)


@dataclass(frozen=True, kw_only=True)
class Placement:
    """Which of an object's equivalent poses to take, and where to stand for it.

    Attributes:
        symmetry: (4, 4) S, a turn about the object's z axis.
        goal: (3,) base goal x, y, yaw [m, m, rad].
        cost: Walking and turning it takes [m].
    """

    symmetry: np.ndarray
    goal: np.ndarray
    cost: float


def symmetry_group(symmetry: tuple[float, ...] | Literal["any"]) -> np.ndarray:
    """Return the turns (n, 4, 4) about z after which an object looks the same; a round one's are sampled."""
    if symmetry == "any":
        angles = np.arange(ANY_YAW_CANDIDATES) * (2.0 * math.pi / ANY_YAW_CANDIDATES)
    else:
        angles = np.array(symmetry, dtype=np.float64)
    return poses.planar(0.0, 0.0, angles)


def choose_placement(
    symmetry: tuple[float, ...] | Literal["any"],
    *,
    T_W_Rd: np.ndarray,
    T_W_Od: np.ndarray,
    T_W_O: np.ndarray,
    T_W_R: np.ndarray,
    clearance_m: float = 0.0,
    bend_cost: float = 0.0,
    others: Sequence[tuple[np.ndarray, np.ndarray]] = (),
) -> Placement:
    """Choose the symmetry that costs least walking and turning (with it the arms move least: they follow the base).

    With more than one object it must also leave the others where the motion expects them: a round bottle may be taken
    from any side, but not the bottle beside a cup.

    Args:
        symmetry: The object's, as in ``ObjectSpec``.
        T_W_Rd: (4, 4) demonstrated root at the start of the segment.
        T_W_Od: (4, 4) demonstrated object then.
        T_W_O: (4, 4) object now.
        T_W_R: (4, 4) root now.
        clearance_m: Distance that the walk must keep from the object; a way around it costs its length.
        bend_cost: What a way around it costs beyond its length [m].
        others: Demonstrated and present pose (4, 4) of each other object.
    """
    here = poses.to_planar(T_W_R)
    best: Placement | None = None
    candidates = symmetry_group(symmetry)
    if symmetry == "any" and others:
        candidates = _aligning_turn(T_W_Od, T_W_O, *others[0])[None]
    for S in candidates:
        goal = base_goal(T_W_Rd, T_W_Od, T_W_O, S)
        length = walk_length(here[:2], goal[:2], T_W_O[:2, 3], clearance_m)
        cost = length + TURN_WEIGHT * abs(float(poses.wrap_angle(goal[2] - here[2])))
        if bend_cost > 0.0 and length > float(norm(goal[:2] - here[:2])) + 1e-9:
            cost += bend_cost
        motion = scene_motion(T_W_Od, T_W_O, S)
        cost += LAYOUT_WEIGHT * sum(float(norm((motion @ then - now)[:2, 3])) for then, now in others)
        if best is None or cost < best.cost - 1e-9:
            best = Placement(symmetry=S, goal=goal, cost=cost)
    assert best is not None  # every group holds the identity
    return best


def _aligning_turn(T_W_Od: np.ndarray, T_W_O: np.ndarray, then: np.ndarray, now: np.ndarray) -> np.ndarray:
    """Return the turn (4, 4) of a round object after which another lies in the direction that the motion expects."""
    seen_then, seen_now = (then - T_W_Od)[:2, 3], (now - T_W_O)[:2, 3]
    turned = math.atan2(seen_now[1], seen_now[0]) - math.atan2(seen_then[1], seen_then[0])
    return poses.planar(0.0, 0.0, turned - float(poses.yaw(T_W_O)) + float(poses.yaw(T_W_Od)))


def walk_length(start: np.ndarray, goal: np.ndarray, obstacle: np.ndarray, clearance_m: float) -> float:
    """Return the length [m] of the shortest way from start to goal (2,) that keeps clear of a round obstacle.

    Where an end lies inside the clearance, the clearance shrinks to it.
    """
    to_start, to_goal = start - obstacle, goal - obstacle
    radius = min(clearance_m, float(norm(to_start)), float(norm(to_goal)))
    straight = goal - start
    length = float(norm(straight))
    if length < 1e-9 or radius <= 0.0:
        return length
    share = float(np.clip(-dot(to_start, straight) / length**2, 0.0, 1.0))
    if norm(to_start + share * straight) >= radius - 1e-9:
        return length
    distances = [float(norm(end)) for end in (to_start, to_goal)]
    tangents = sum(math.sqrt(max(distance**2 - radius**2, 0.0)) for distance in distances)
    between = math.acos(float(np.clip(dot(to_start, to_goal) / (distances[0] * distances[1]), -1.0, 1.0)))
    arc = between - sum(math.acos(min(1.0, radius / distance)) for distance in distances)
    return tangents + radius * max(arc, 0.0)
