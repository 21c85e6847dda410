"""Retargeting keeps what makes a demonstration work: itself, planar motions, lifts, squeezes, continuity."""

import math
from typing import Literal

import numpy as np
import pytest

from gym_demohlm import poses
from lerobot_demohlm.demonstrations.segments import ANCHORS, Anchor
from lerobot_demohlm.generation import retarget

SEEDS = range(25)
SQUARE = (0.0, math.pi / 2, math.pi, -math.pi / 2)
EYE = np.eye(4)


def random_pose(rng: np.random.Generator, shape: tuple[int, ...] = ()) -> np.ndarray:
    """Return poses anywhere within a metre, turned in any way."""
    return poses.pose(rng.normal(size=(*shape, 3)), rng.normal(size=(*shape, 4)))


def random_planar(rng: np.random.Generator) -> np.ndarray:
    """Return a motion of the floor plane onto itself."""
    return poses.planar(*rng.uniform(-2, 2, size=2), rng.uniform(-math.pi, math.pi))


def upright(rng: np.random.Generator) -> np.ndarray:
    """Return the pose of something that stands on the floor."""
    T = random_planar(rng)
    T[2, 3] = rng.uniform(0.1, 0.8)
    return T


class Scene:
    """A made-up demonstration: root, object, and two hands that approach, then act together."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.rng = rng
        self.root, self.object = upright(rng), upright(rng)
        self.approach = random_pose(rng, (6, 2))
        self.act = random_pose(rng, (8, 2))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ANCHORS)
def test_its_own_start_reproduces_the_demonstration(seed: int, kind: Anchor) -> None:
    """Nothing moved: every target and the base goal are the demonstrated ones."""
    scene = Scene(seed)
    targets = retarget.object_targets(scene.approach, scene.object, scene.object, EYE)
    np.testing.assert_allclose(targets, scene.approach, atol=1e-9)
    goal = retarget.base_goal(scene.root, scene.object, scene.object, EYE)
    np.testing.assert_allclose(goal, poses.to_planar(scene.root), atol=1e-9)
    last = scene.approach[-1]
    anchor = retarget.anchor_pose(kind, last, scene.root)
    again = retarget.anchored_targets(scene.act, last, last, anchor, anchor)
    np.testing.assert_allclose(again, scene.act, atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ["eef_heading", "eef", "root"])
def test_moving_the_scene_moves_the_targets(seed: int, kind: Anchor) -> None:
    """A planar motion of object and robot is a motion of all targets and of the base goal."""
    scene = Scene(seed)
    M = random_planar(scene.rng)
    targets = retarget.object_targets(scene.approach, scene.object, M @ scene.object, EYE)
    np.testing.assert_allclose(targets, M @ scene.approach, atol=1e-8)
    goal = retarget.base_goal(scene.root, scene.object, M @ scene.object, EYE)
    np.testing.assert_allclose(poses.planar(*goal), poses.planar(*poses.to_planar(M @ scene.root)), atol=1e-8)
    last_d, last = scene.approach[-1], M @ scene.approach[-1]
    anchor_d = retarget.anchor_pose(kind, last_d, scene.root)
    anchor = retarget.anchor_pose(kind, last, M @ scene.root)
    moved = retarget.anchored_targets(scene.act, last_d, last, anchor_d, anchor)
    np.testing.assert_allclose(moved, M @ scene.act, atol=1e-8)


@pytest.mark.parametrize("seed", SEEDS)
def test_targets_move_with_the_scene_from_any_start(seed: int) -> None:
    """Also where robot and object are not in the demonstrated relation: f(M scene) = M f(scene)."""
    scene = Scene(seed)
    root, thing, last = upright(scene.rng), upright(scene.rng), random_pose(scene.rng, (2,))
    M = random_planar(scene.rng)

    def act(T_W_R: np.ndarray, T_W_E: np.ndarray) -> np.ndarray:
        last_d = scene.approach[-1]
        anchor_d = retarget.anchor_pose("eef_heading", last_d, scene.root)
        anchor = retarget.anchor_pose("eef_heading", T_W_E, T_W_R)
        return retarget.anchored_targets(scene.act, last_d, T_W_E, anchor_d, anchor)

    np.testing.assert_allclose(act(M @ root, M @ last), M @ act(root, last), atol=1e-8)
    here = retarget.object_targets(scene.approach, scene.object, thing, EYE)
    there = retarget.object_targets(scene.approach, scene.object, M @ thing, EYE)
    np.testing.assert_allclose(there, M @ here, atol=1e-8)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ["eef_heading", "root", "world"])
def test_a_lift_stays_a_lift(seed: int, kind: Anchor) -> None:
    """Hands that rise by h in the demonstration rise by +h anywhere, upright, and go nowhere else."""
    scene = Scene(seed)
    heights = np.linspace(0.0, 0.5, 8)
    last_d, last = scene.approach[-1], random_pose(scene.rng, (2,))
    lift = np.tile(last_d, (8, 1, 1, 1))
    lift[..., 2, 3] += heights[:, None]
    anchor_d = retarget.anchor_pose(kind, last_d, scene.root)
    anchor = retarget.anchor_pose(kind, last, upright(scene.rng))
    targets = retarget.anchored_targets(lift, last_d, last, anchor_d, anchor)
    expected = np.tile(last, (8, 1, 1, 1))
    expected[..., 2, 3] += heights[:, None]
    np.testing.assert_allclose(targets, expected, atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ANCHORS)
def test_targets_are_continuous_at_the_switch(seed: int, kind: Anchor) -> None:
    """A demonstration that does not jump at c gives targets that do not, wherever robot and hands are."""
    scene = Scene(seed)
    last_d, last = scene.approach[-1], random_pose(scene.rng, (2,))
    anchor_d = retarget.anchor_pose(kind, last_d, scene.root)
    anchor = retarget.anchor_pose(kind, last, upright(scene.rng))
    first = retarget.anchored_targets(last_d[None], last_d, last, anchor_d, anchor)[0]
    np.testing.assert_allclose(first, last, atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("hands", [1, 2])
def test_hands_that_come_to_the_body_do_so_from_anywhere(seed: int, hands: int) -> None:
    """They begin where they are, rest while the demonstration rests, and end at its place on the robot."""
    scene = Scene(seed)
    path = np.concatenate([np.repeat(scene.act[:1], 3, axis=0), scene.act])[:, :hands]
    share = retarget.progress(path)
    assert (np.diff(share) >= 0.0).all()
    np.testing.assert_array_equal(share[[0, 1, 2, 3, -1]], [0.0, 0.0, 0.0, 0.0, 1.0])
    lifted = poses.pose([0.05, -0.1, 0.2]) @ poses.planar(0.0, 0.0, 0.1)
    for start in (path[0], lifted @ path[0]):
        led = retarget.bring(start, path, share)
        np.testing.assert_allclose(led[:4], np.repeat(start[None], 4, axis=0), atol=1e-9)
        np.testing.assert_allclose(led[-1], path[-1], atol=1e-8)
    np.testing.assert_allclose(retarget.bring(path[0], path, share), path, atol=1e-8)


@pytest.mark.parametrize("seed", SEEDS)
def test_hands_that_come_to_the_body_keep_their_squeeze(seed: int) -> None:
    scene = Scene(seed)
    path = random_pose(scene.rng, (8, 1)) @ scene.approach[-1]
    squeezed = path[0].copy()
    squeezed[0, :3, 3] += 0.02 * (path[0, 1] - path[0, 0])[:3, 3]
    led = retarget.bring(squeezed, path, retarget.progress(path))
    relation = poses.invert(led[:, 0]) @ led[:, 1]
    np.testing.assert_allclose(relation, np.tile(relation[0], (8, 1, 1)), atol=1e-8)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_squeeze_stays_a_squeeze(seed: int) -> None:
    """Two hands that move as one rigid body keep their distance; a closing motion keeps its size."""
    scene = Scene(seed)
    last_d, last = scene.approach[-1], random_pose(scene.rng, (2,))
    together = random_pose(scene.rng, (8, 1)) @ last_d
    anchor_d = retarget.anchor_pose("eef_heading", last_d, scene.root)
    anchor = retarget.anchor_pose("eef_heading", last, upright(scene.rng))
    targets = retarget.anchored_targets(together, last_d, last, anchor_d, anchor)
    relation = poses.invert(targets[:, 0]) @ targets[:, 1]
    np.testing.assert_allclose(relation, np.tile(poses.invert(last[0]) @ last[1], (8, 1, 1)), atol=1e-8)
    closing = np.tile(last_d, (1, 1, 1, 1))
    closing[0, :, :3, 3] += [[0.0, -0.02, 0.0], [0.0, 0.02, 0.0]]
    closed = retarget.anchored_targets(closing, last_d, last, anchor_d, anchor)[0]
    step = closed[:, :3, 3] - last[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(step, axis=-1), 0.02)
    np.testing.assert_allclose(step[0], -step[1], atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_square_box_is_met_at_its_nearest_face(seed: int) -> None:
    """For whatever yaw of the box, the robot turns at most 45 degrees away from facing it."""
    rng = np.random.default_rng(seed)
    root, box_d = EYE, poses.pose([0.4, 0.0, 0.3])
    box = poses.planar(0.35, 0.0, rng.uniform(-math.pi, math.pi))
    box[2, 3] = 0.25
    start = poses.planar(-0.8, 0.0, 0.0)
    placement = retarget.choose_placement(SQUARE, T_W_Rd=root, T_W_Od=box_d, T_W_O=box, T_W_R=start)
    assert abs(placement.goal[2]) <= math.pi / 4 + 1e-9
    assert np.linalg.norm(placement.goal[:2] - box[:2, 3]) == pytest.approx(0.4)
    costs = []
    for angle in SQUARE:
        goal = retarget.base_goal(root, box_d, box, poses.planar(0.0, 0.0, angle))
        turn = abs(float(poses.wrap_angle(goal[2])))
        costs.append(np.linalg.norm(goal[:2] - start[:2, 3]) + retarget.TURN_WEIGHT * turn)
    assert placement.cost == pytest.approx(min(costs))


def test_a_round_object_costs_no_detour() -> None:
    """For a round object the robot goes straight to it, whatever yaw its frame has."""
    box_d = poses.pose([0.4, 0.0, 0.3])
    box = poses.planar(1.0, 0.0, 2.345)
    placement = retarget.choose_placement("any", T_W_Rd=EYE, T_W_Od=box_d, T_W_O=box, T_W_R=EYE)
    assert placement.cost < 0.63
    assert abs(placement.goal[2]) < math.radians(2.6)


def test_a_way_around_an_obstacle_is_longer_than_through_it() -> None:
    """Straight where free, tangents and an arc where not."""
    origin, across = np.array([-1.0, 0.0]), np.array([1.0, 0.0])
    assert retarget.walk_length(origin, across, np.array([0.0, 2.0]), 0.5) == pytest.approx(2.0)
    around = retarget.walk_length(origin, across, np.zeros(2), 0.5)
    expected = 2 * math.sqrt(0.75) + 0.5 * (math.pi - 2 * math.acos(0.5))
    assert around == pytest.approx(expected)


@pytest.mark.parametrize("seed", SEEDS)
def test_transit_ends_at_its_target_without_jumps(seed: int) -> None:
    """The last pose is exact, steps are small at both ends, and none is larger than 1.5 times the mean."""
    rng = np.random.default_rng(seed)
    start, end = random_pose(rng, (2,)), random_pose(rng, (2,))
    path = retarget.transit(start, end, 20)
    assert path.shape == (20, 2, 4, 4)
    np.testing.assert_array_equal(path[-1], end)
    steps = np.linalg.norm(np.diff(np.concatenate([start[None], path])[..., :3, 3], axis=0), axis=-1)
    distance = np.linalg.norm(end[:, :3, 3] - start[:, :3, 3], axis=-1)
    assert (steps <= 1.51 * distance / 20).all()
    assert (steps[[0, -1]] <= 0.2 * distance / 20).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_joining_a_path_is_its_motion_and_a_transit_together(seed: int) -> None:
    """A path at rest is joined by a transit, one that begins where the hands are is left as it is, the end is exact."""
    rng = np.random.default_rng(seed)
    start, end = random_pose(rng, (2,)), random_pose(rng, (2,))
    resting = np.broadcast_to(end, (20, 2, 4, 4))
    joined = retarget.join(start, resting)
    np.testing.assert_allclose(joined[..., :3, 3], retarget.transit(start, end, 20)[..., :3, 3], atol=1e-9)
    moving = retarget.transit(start, end, 20)
    np.testing.assert_allclose(retarget.join(moving[0], moving), moving, atol=1e-9)
    joined = retarget.join(random_pose(rng, (2,)), moving)
    np.testing.assert_allclose(joined[-1], end, atol=1e-9)
    np.testing.assert_allclose(joined @ poses.invert(joined), np.broadcast_to(np.eye(4), joined.shape), atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_hands_on_a_walking_base_keep_their_place_on_it(seed: int) -> None:
    scene = Scene(seed)
    moved = random_planar(scene.rng) @ scene.root
    carried = retarget.carried_targets(scene.approach[0], scene.root, moved)
    np.testing.assert_allclose(poses.invert(moved) @ carried, poses.invert(scene.root) @ scene.approach[0], atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("symmetry", ["any", SQUARE])
def test_a_second_object_decides_from_where_to_act(seed: int, symmetry: tuple[float, ...] | Literal["any"]) -> None:
    """Where bottle and bowl have both been moved by one planar motion, the base goal has been, however they turned."""
    scene = Scene(seed)
    bowl = upright(scene.rng)
    motion = random_planar(scene.rng)
    spin = scene.rng.uniform(-math.pi, math.pi) if symmetry == "any" else scene.rng.choice(SQUARE)
    placement = retarget.choose_placement(
        symmetry,
        T_W_Rd=scene.root,
        T_W_Od=scene.object,
        T_W_O=motion @ scene.object @ poses.planar(0.0, 0.0, spin),
        T_W_R=upright(scene.rng),
        others=[(bowl, motion @ bowl @ poses.planar(0.0, 0.0, 1.0))],
    )
    expected = poses.to_planar(motion @ scene.root)
    np.testing.assert_allclose(placement.goal[:2], expected[:2], atol=1e-9)
    np.testing.assert_allclose(poses.wrap_angle(placement.goal[2] - expected[2]), 0.0, atol=1e-9)
