"""What an episode has drawn: named numbers that are written into its initial state and read from there again.

In an initial state a condition is a key with a dot, ``objects.mass.cube``, beside the keys of the start itself. So what
stores, sends or hashes starts does the same with conditions, and a stored episode needs no draw to be repeated.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.task import InitialState
from gym_demohlm.variation.factors import CLUTTER, FACTORS, LIMBS

SEED = "robot.seed"
_KNOWN = {"limb": tuple(LIMBS), "clutter": CLUTTER}  # what has numbers of its own, where the task does not say it


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """The numbers of one episode.

    Attributes:
        values: By the factor's key, with the name of a limb or an object behind it where each has its own.

    Raises:
        UnknownNameError: A key is of no factor, or not of what has numbers of its own. The scene knows the objects.
        SceneError: A factor has too many numbers or too few, or one beyond its bounds.
    """

    values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check names and numbers: they may come from a file."""
        for key, numbers in self.values.items():
            if key == SEED:
                if len(numbers) != 1 or not (math.isfinite(numbers[0]) and numbers[0] >= 0.0):
                    raise SceneError(f"{key}={list(numbers)}", "one number, 0 or more", "restore the start")
                continue
            group, _, rest = key.partition(".")
            name, dot, target = rest.partition(".")
            factor = FACTORS.get(f"{group}.{name}")
            if factor is None:
                raise UnknownNameError("condition", key, FACTORS)
            known = _KNOWN.get(factor.each)
            if bool(dot) != (factor.each != "episode") or (known is not None and target not in known):
                expected = known or (["no name"] if factor.each == "episode" else ["the name of an object"])
                raise UnknownNameError(f"{factor.key} of", target, expected)
            low, high = factor.bounds
            if len(numbers) != factor.size or not all(math.isfinite(n) and low <= n <= high for n in numbers):
                raise SceneError(
                    f"{key}={list(numbers)}", f"{factor.size} numbers from {low:g} to {high:g}", "restore the start"
                )

    @classmethod
    def read(cls, state: InitialState) -> "Conditions":
        """Return the conditions that an initial state holds; none of a plain one."""
        return cls(values={key: tuple(numbers) for key, numbers in state.items() if "." in key})

    def write(self) -> InitialState:
        """Return them as keys of an initial state."""
        return {key: list(numbers) for key, numbers in self.values.items()}

    def groups(self) -> set[str]:
        """Return the groups that they are of."""
        return {key.partition(".")[0] for key in self.values}

    def objects(self) -> set[str]:
        """Return the names of the objects that have numbers of their own."""
        parts = (key.split(".", 2) for key in self.values if key != SEED)
        return {rest[0] for group, name, *rest in parts if FACTORS[f"{group}.{name}"].each == "object"}

    def __bool__(self) -> bool:
        """Return whether anything differs from the plain world."""
        return bool(self.values)

    def numbers(self, key: str, target: str = "") -> tuple[float, ...] | None:
        """Return the numbers of a factor, of a limb or object where each has its own; None where it does not vary."""
        return self.values.get(f"{key}.{target}" if target else key)

    def number(self, key: str, target: str = "", *, plain: float) -> float:
        """Return the one number of a factor, or ``plain`` where it does not vary."""
        found = self.numbers(key, target)
        return plain if found is None else found[0]
