"""A word -> the pieces of straight line that write it, as it stands on a board and can be wiped off piece by piece."""

import math

import numpy as np

from gym_demohlm.arithmetic import norm
from gym_demohlm.errors import UnknownNameError

# Strokes in units of a letter's width and height: x0, z0, x1, z1 from its lower left corner.
_STROKES: dict[str, tuple[tuple[float, float, float, float], ...]] = {
    "E": ((0, 0, 0, 1), (0, 1, 1, 1), (0, 0.5, 0.8, 0.5), (0, 0, 1, 0)),
    "H": ((0, 0, 0, 1), (1, 0, 1, 1), (0, 0.5, 1, 0.5)),
    "L": ((0, 0, 0, 1), (0, 0, 1, 0)),
    "O": ((0, 0, 0, 1), (1, 0, 1, 1), (0, 0, 1, 0), (0, 1, 1, 1)),
}


def write(word: str, letter_size: tuple[float, float], pitch: float, piece_length: float) -> np.ndarray:
    """Return the pieces of a word as x0, z0, x1, z1 (n, 4) [m]: x to the right, z up, from the word's middle.

    Args:
        word: In capitals.
        letter_size: Width and height of a letter [m].
        pitch: From one letter to the next [m].
        piece_length: Longest piece that a stroke is cut into [m].

    Raises:
        UnknownNameError: There are no strokes for a letter.
    """
    pieces = []
    for index, letter in enumerate(word):
        if letter not in _STROKES:
            raise UnknownNameError("letter", letter, _STROKES)
        left = (index - (len(word) - 1) / 2) * pitch - letter_size[0] / 2
        for x0, z0, x1, z1 in _STROKES[letter]:
            ends = np.array([[x0, z0 - 0.5], [x1, z1 - 0.5]]) * letter_size + [left, 0.0]
            cuts = math.ceil(float(norm(ends[1] - ends[0])) / piece_length)
            shares = np.linspace(0.0, 1.0, cuts + 1)[:, None]
            points = (1.0 - shares) * ends[0] + shares * ends[1]
            pieces.append(np.concatenate([points[:-1], points[1:]], axis=1))
    return np.concatenate(pieces)
