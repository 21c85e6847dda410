"""Poses form a group, interpolate between their ends, and keep their heading."""

import numpy as np
import pytest

from gym_demohlm import poses

SEEDS = range(20)


def random_poses(seed: int, shape: tuple[int, ...] = (7,)) -> np.ndarray:
    """Return poses with uniformly random rotations and positions within a few metres."""
    rng = np.random.default_rng(seed)
    return poses.pose(rng.normal(scale=2.0, size=(*shape, 3)), rng.normal(size=(*shape, 4)))


@pytest.mark.parametrize("seed", SEEDS)
def test_poses_form_a_group(seed: int) -> None:
    """Identity, inverse and associativity hold, and products stay rigid."""
    A, B, C = (random_poses(seed * 3 + k) for k in range(3))
    eye = np.broadcast_to(np.eye(4), A.shape)
    np.testing.assert_allclose(A @ poses.invert(A), eye, atol=1e-12)
    np.testing.assert_allclose(poses.invert(A) @ A, eye, atol=1e-12)
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-11)
    np.testing.assert_allclose(poses.invert(A @ B), poses.invert(B) @ poses.invert(A), atol=1e-11)
    R = (A @ B @ C)[..., :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), eye[..., :3, :3], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_parametrisations_round_trip(seed: int) -> None:
    """Quaternion, rotation vector and roll-pitch-yaw give the matrix back."""
    T = random_poses(seed)
    R = T[..., :3, :3]
    position, quat_wxyz = poses.split(T)
    assert (quat_wxyz[..., 0] >= 0).all()
    np.testing.assert_allclose(poses.pose(position, quat_wxyz), T, atol=1e-12)
    np.testing.assert_allclose(poses.rotation_from_vector(poses.rotation_vector(R)), R, atol=1e-12)
    np.testing.assert_allclose(poses.rotation_from_rpy(poses.rpy(R)), R, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-13, 1e-9, 1e-4, 1.0, np.pi - 1e-9, np.pi])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, -1, 0), (0, 0, 1), (0.6, 0.0, 0.8)])
def test_rotation_vectors_at_their_limits(angle: float, axis: tuple[float, ...]) -> None:
    """Very small turns and half turns keep their angle."""
    R = poses.rotation_from_vector(angle * np.array(axis))
    vector = poses.rotation_vector(R)
    np.testing.assert_allclose(np.linalg.norm(vector), angle, atol=1e-12)
    np.testing.assert_allclose(poses.rotation_from_vector(vector), R, atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_interpolation_meets_both_ends_at_constant_speed(seed: int) -> None:
    """The ends are exact; half way is equally far from both; the turn grows linearly."""
    T0, T1 = random_poses(seed), random_poses(seed + 1000)
    np.testing.assert_array_equal(poses.interpolate(T0, T1, 0.0), T0)
    np.testing.assert_array_equal(poses.interpolate(T0, T1, 1.0), T1)

    def angle(A: np.ndarray, B: np.ndarray) -> np.ndarray:
        return np.linalg.norm(poses.rotation_vector(np.swapaxes(A[..., :3, :3], -1, -2) @ B[..., :3, :3]), axis=-1)

    for u in (0.25, 0.5, 0.9):
        T = poses.interpolate(T0, T1, u)
        np.testing.assert_allclose(angle(T0, T), u * angle(T0, T1), atol=1e-9)
        np.testing.assert_allclose(T[..., :3, 3], (1 - u) * T0[..., :3, 3] + u * T1[..., :3, 3], atol=1e-12)


def test_interpolation_broadcasts_over_time() -> None:
    """One pair of poses and many shares make a path."""
    T0, T1 = random_poses(0, ()), random_poses(1, ())
    path = poses.interpolate(T0, T1, np.linspace(0, 1, 5))
    assert path.shape == (5, 4, 4)
    np.testing.assert_array_equal(path[0], T0)
    np.testing.assert_array_equal(path[-1], T1)


@pytest.mark.parametrize("seed", SEEDS)
def test_heading_is_upright_and_turns_with_the_world(seed: int) -> None:
    """Heading keeps position and yaw, is idempotent, and commutes with planar motions of the whole world."""
    T = random_poses(seed)
    H = poses.heading(T)
    np.testing.assert_allclose(H[..., :3, 3], T[..., :3, 3])
    np.testing.assert_allclose(poses.yaw(H), poses.yaw(T), atol=1e-12)
    np.testing.assert_allclose(H[..., :3, 2], np.broadcast_to([0, 0, 1.0], (7, 3)))
    np.testing.assert_allclose(poses.heading(H), H, atol=1e-12)
    M = poses.planar(0.3, -1.2, 2.1)
    np.testing.assert_allclose(poses.heading(M @ T), M @ H, atol=1e-9)


def test_planar_motions_compose_and_read_back() -> None:
    """``to_planar`` reads what ``planar`` wrote, and turns add up."""
    x, y, yaw = np.array([0.1, -2.0]), np.array([0.5, 0.0]), np.array([0.4, -3.0])
    np.testing.assert_allclose(poses.to_planar(poses.planar(x, y, yaw)), np.stack([x, y, yaw], axis=-1))
    product = poses.planar(1.0, 0.0, np.pi / 2) @ poses.planar(1.0, 0.0, 0.0)
    np.testing.assert_allclose(poses.to_planar(product), [1.0, 1.0, np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(poses.wrap_angle([3 * np.pi / 2, -3 * np.pi / 2]), [-np.pi / 2, np.pi / 2])


def test_transform_moves_points_as_poses_do() -> None:
    """Moving a point equals composing with a pose at that point."""
    T, point = random_poses(3), np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(poses.transform(T, point), (T @ poses.pose(point))[..., :3, 3])


def test_batched_results_equal_single_ones_bit_for_bit() -> None:
    """A pose gets the same bits alone and in a batch: attempts must not depend on their company."""
    A, B = random_poses(5, (33,)), random_poses(6, (33,))
    for k in range(33):
        np.testing.assert_array_equal(poses.interpolate(A, B, 0.3)[k], poses.interpolate(A[k], B[k], 0.3))
        np.testing.assert_array_equal(poses.invert(A)[k], poses.invert(A[k]))
        np.testing.assert_array_equal(poses.matrix_to_quat(A[..., :3, :3])[k], poses.matrix_to_quat(A[k, :3, :3]))
