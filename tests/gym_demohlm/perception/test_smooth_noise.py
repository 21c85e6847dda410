"""Pieces of noise have the deviation and the correlation that was asked for, and are unlike one another."""

import math

import numpy as np
import pytest

from gym_demohlm.perception import smooth_noise


@pytest.mark.parametrize("blur", [0.0, 1.0, 2.0, 4.0])
def test_a_piece_is_normal_noise_that_is_correlated_as_its_blur_leaves_it(blur: float) -> None:
    rng = np.random.default_rng(5)
    noise = np.stack([smooth_noise.piece((200, 300), blur, rng, deviation=0.5) for _ in range(20)])
    assert noise.dtype == np.float32
    # About 20 * 60,000 / (4 pi b^2) independent pixels at most: 3 % is three deviations of the estimate at b = 4.
    assert noise.std() == pytest.approx(0.5, rel=0.03)
    assert abs(noise.mean()) < 0.02
    assert np.mean(noise < 0.5 * -1.2816) == pytest.approx(0.1, abs=0.01)
    for axis in (1, 2):
        near = np.mean(np.take(noise, range(100), axis=axis) * np.take(noise, range(2, 102), axis=axis)) / 0.25
        assert near == pytest.approx(math.exp(-((2 / (2 * blur)) ** 2)) if blur else 0.0, abs=0.06)


def test_two_pieces_of_one_frame_have_nothing_in_common() -> None:
    rng = np.random.default_rng(0)
    pieces = [smooth_noise.piece((240, 320), 2.0, rng).ravel() for _ in range(12)]
    likeness = np.corrcoef(pieces) - np.eye(12)
    assert np.abs(likeness).max() < 0.06


def test_the_same_generator_gives_the_same_bits_and_what_it_gives_may_be_written_to() -> None:
    first, again = (smooth_noise.piece((30, 40), 2.0, np.random.default_rng(3)) for _ in range(2))
    assert first.tobytes() == again.tobytes()
    first[:] = 0.0
    again_after = smooth_noise.piece((30, 40), 2.0, np.random.default_rng(3))
    assert again_after.tobytes() == again.tobytes()


def test_a_picture_larger_than_the_sheet_has_fresh_noise() -> None:
    noise = smooth_noise.piece((1600, 2000), 2.0, np.random.default_rng(1), deviation=2.0)
    assert noise.shape == (1600, 2000)
    assert noise.std() == pytest.approx(2.0, rel=0.02)
