"""The depth camera's errors have the size of their formulas."""

from dataclasses import replace

import numpy as np
import pytest

from gym_demohlm.errors import SceneError
from gym_demohlm.perception import d435

FOCAL = 617.0
PLAIN = replace(d435.NO_NOISE, subpixel=0.08)


@pytest.mark.parametrize("distance", [0.4, 0.8, 1.2])
def test_the_noise_has_the_deviation_of_the_formula(distance: float) -> None:
    depth = np.full((400, 600), distance, np.float32)
    measured = d435.measure(depth, PLAIN, np.random.default_rng(0), image_focal=FOCAL)
    expected = distance**2 * 0.08 / (383.0 * 0.05)
    assert PLAIN.sigma(np.array(distance)) == pytest.approx(expected)
    # 400 x 600 pixels whose noise is correlated over about 50: 2 % is four deviations of the estimate.
    assert measured.std() == pytest.approx(expected, rel=0.04)


def test_disparity_comes_in_steps_of_a_thirty_second_of_a_pixel() -> None:
    noise = replace(PLAIN, disparity_step=1 / 32)
    depth = np.linspace(0.3, 2.0, 20000, dtype=np.float32).reshape(100, 200)
    measured = d435.measure(depth, noise, np.random.default_rng(0), image_focal=FOCAL).astype(np.float64)
    steps = 383.0 * 0.05 / measured * 32
    np.testing.assert_allclose(steps, np.round(steps), atol=2e-3)


def test_without_noise_depth_is_true() -> None:
    depth = np.random.default_rng(0).uniform(0.3, 3.0, (60, 80)).astype(np.float32)
    measured = d435.measure(depth, d435.NO_NOISE, np.random.default_rng(0), image_focal=FOCAL)
    np.testing.assert_allclose(measured, depth, rtol=1e-6)


def test_an_episode_has_one_factor() -> None:
    scale = d435.episode_scale(d435.DepthNoise(scale_sigma=0.003), np.random.default_rng(3))
    assert scale != 1.0 and abs(scale - 1.0) < 0.012
    depth = np.full((8, 8), 1.0, np.float32)
    measured = d435.measure(depth, d435.NO_NOISE, np.random.default_rng(0), scale=scale, image_focal=FOCAL)
    np.testing.assert_allclose(measured, scale, rtol=1e-6)


def test_the_shadow_lies_left_of_a_near_thing_and_is_as_wide_as_the_disparities_differ() -> None:
    depth = np.full((20, 200), 1.0, np.float32)
    depth[:, 100:] = 0.5
    hidden = d435.shadow(383.0 * 0.05 / depth, FOCAL / 383.0)
    width = 383.0 * 0.05 * (1 / 0.5 - 1 / 1.0) * FOCAL / 383.0  # 30.9 px
    assert not hidden[:, 100:].any() and not hidden[:, : 100 - int(width) - 1].any()
    assert hidden[:, 76:100].all()


def test_what_is_too_near_too_far_or_transparent_has_holes() -> None:
    depth = np.full((100, 100), 1.0, np.float32)
    depth[:10], depth[10:20] = 0.1, 7.0
    behind = depth.copy()
    behind[50:] = 1.4
    noise = replace(d435.NO_NOISE, transparent_holes=0.5)
    measured = d435.measure(depth, noise, np.random.default_rng(0), image_focal=FOCAL, behind=behind)
    assert (measured[:20] == d435.HOLE).all() and (measured[20:50] == 1.0).all()
    glass = measured[50:]
    assert set(np.unique(glass)) == {np.float32(d435.HOLE), np.float32(1.4)}
    assert 0.3 < (glass == d435.HOLE).mean() < 0.7


def test_the_same_seed_gives_the_same_bits_and_another_one_others() -> None:
    depth = np.random.default_rng(0).uniform(0.3, 3.0, (60, 80)).astype(np.float32)

    def once(seed: int) -> np.ndarray:
        return d435.measure(depth, d435.DepthNoise(), np.random.default_rng(seed), image_focal=FOCAL)

    assert once(1).tobytes() == once(1).tobytes()
    assert once(1).tobytes() != once(2).tobytes()


def test_negative_noise_is_an_error() -> None:
    with pytest.raises(SceneError, match="subpixel"):
        d435.DepthNoise(subpixel=-0.1)
