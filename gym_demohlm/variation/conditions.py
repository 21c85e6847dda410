"""What an episode has drawn: named numbers that are written into its initial state and read from there again.

In an initial state a condition is a key with a dot, ``objects.mass.cube``, beside the keys of the start itself. So what
stores, sends or hashes starts does the same with conditions, and a stored episode needs no draw to be repeated.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.task import InitialState
from gym_demohlm.variation.factors import FACTORS

SEED = "robot.seed"


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """The numbers of one episode.

    Attributes:
        values: By the factor's key, with the name of a limb or an object behind it where each has its own.

    Raises:
        UnknownNameError: A key is of no factor.
        SceneError: A factor has too many numbers or too few, or one beyond its bounds.
    """

    values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check names and numbers: they may come from a file."""
        for key, numbers in self.values.items():
            if key == SEED:
                continue
            factor = FACTORS.get(".".join(key.split(".")[:2]))
            if factor is None:
                raise UnknownNameError("condition", key, FACTORS)
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
