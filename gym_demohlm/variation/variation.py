"""A name such as ``real`` or ``hard@0.5:objects+pushes`` -> the ranges from which an episode draws its conditions."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.variation.conditions import Conditions
from gym_demohlm.variation.factors import CLUTTER, FACTORS, GROUPS, LIMBS, Factor, Range

PRESETS = ("none", "real", "hard")
VARIATION_STREAM = 9  # first number of its seed sequences: no draw of another stream changes with a variation
_DIGITS = 4  # of a draw: what is written is what is used


@dataclass(frozen=True, kw_only=True)
class Variation:
    """From where an episode draws what is different in its world.

    Attributes:
        name: As on the command line.
        ranges: Range of each factor that varies, by the factor's key.

    Raises:
        UnknownNameError: There is no such factor.
        SceneError: A range is empty, or beyond what the model can stand for.
    """

    name: str
    ranges: Mapping[str, Range]

    def __post_init__(self) -> None:
        """Check the ranges."""
        for key, range_ in self.ranges.items():
            if key not in FACTORS:
                raise UnknownNameError("factor", key, FACTORS)
            FACTORS[key].check(range_)

    def __bool__(self) -> bool:
        """Return whether anything varies."""
        return bool(self.ranges)

    @property
    def groups(self) -> tuple[str, ...]:
        """The groups that vary, in the order of ``GROUPS``."""
        return tuple(group for group in GROUPS if any(FACTORS[key].group == group for key in self.ranges))

    def draw(self, entropy: int, objects: Sequence[str]) -> Conditions:
        """Draw the conditions of an episode.

        Each factor has a stream of its own, so that what one group draws does not depend on which others vary.

        Args:
            entropy: A function of the episode's task and start.
            objects: Names of the task's loose objects.
        """
        values: dict[str, tuple[float, ...]] = {}
        for key, range_ in self.ranges.items():
            factor = FACTORS[key]
            rng = np.random.default_rng([VARIATION_STREAM, entropy, list(FACTORS).index(key)])
            for target in _targets(factor, objects):
                drawn = rng.uniform(*range_, factor.size)
                values[key + target] = tuple(round(float(value), _DIGITS) for value in drawn)
        if any(FACTORS[key].group == "robot" for key in self.ranges):
            # SeedSequence pads with zeros: the first factor's stream. It stays, as another would change all noise.
            values["robot.seed"] = (float(np.random.default_rng([VARIATION_STREAM, entropy]).integers(2**31)),)
        return Conditions(values=values)


def _targets(factor: Factor, objects: Sequence[str]) -> list[str]:
    """Return what follows the key of each of a factor's draws."""
    names = {"episode": (), "object": objects, "limb": tuple(LIMBS), "clutter": CLUTTER}[factor.each]
    return [""] if factor.each == "episode" else [f".{name}" for name in names]


NONE = Variation(name="none", ranges=MappingProxyType({}))
"""Nothing varies: the bits of a world that knows of no variation."""


def get_variation(name: str) -> Variation:
    """Return a variation by its name: ``PRESET[@STRENGTH][:GROUP+GROUP]``.

    ``real`` is the preset; ``real@0.5`` has its ranges half as far from neutral; ``hard:objects+pushes`` varies these
    two groups alone.

    Raises:
        UnknownNameError: There is no such preset or group.
        SceneError: The strength is no number from 0 to 3.
    """
    if not isinstance(name, str):
        raise UnknownNameError("variation", name, PRESETS)
    head, colon, chosen = name.partition(":")
    preset, at, number = head.partition("@")
    if preset not in PRESETS:
        raise UnknownNameError("variation", preset, PRESETS)
    strength = _strength(number, name) if at else 1.0
    groups = chosen.split("+") if colon else list(GROUPS)
    for group in groups:
        if group not in GROUPS:
            raise UnknownNameError("group", group, GROUPS)
    if preset == "none" or strength == 0.0:
        return NONE
    chosen_factors = {key: factor for key, factor in FACTORS.items() if factor.group in groups}
    ranges = {key: factor.scaled(getattr(factor, preset), strength) for key, factor in chosen_factors.items()}
    return Variation(name=name, ranges=MappingProxyType(ranges))


def _strength(text: str, name: str) -> float:
    try:
        strength = float(text)
    except ValueError:
        strength = math.nan
    if not 0.0 <= strength <= 3.0:
        raise SceneError(f"the variation {name!r}", "a strength from 0 to 3 behind the @", "write it as real@0.5")
    return strength
