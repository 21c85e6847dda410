"""Settings and an episode's conditions -> what is wrong with how it sees, beside the errors of its source."""

from dataclasses import dataclass

from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.task import InitialState
from gym_demohlm.variation import Conditions, Variation

GROUP = "perception"
"""The group of a variation that draws disturbances."""


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """What is wrong with the eyes of one episode.

    Attributes:
        errors: Factor of the fitted errors, with the source "model". With 0 poses are exact and objects are never lost.
        bias_mm: Length of the error of each object's place that stays for the whole episode [mm].
        latency_s: Age of poses when they arrive [s].
        dropout: Share of frames that give no new pose, in [0, 1].
    """

    errors: float = 1.0
    bias_mm: float = 0.0
    latency_s: float = 0.0
    dropout: float = 0.0

    @classmethod
    def of(cls, settings: PerceptionSettings, conditions: Conditions | None = None) -> "Disturbance":
        """Return what settings ask for and conditions add; the errors of an episode that drew none are the fitted."""
        drawn = conditions or Conditions()
        return cls(
            errors=drawn.number(f"{GROUP}.errors", plain=1.0),
            bias_mm=settings.bias_mm + drawn.number(f"{GROUP}.bias", plain=0.0),
            latency_s=settings.latency_s + drawn.number(f"{GROUP}.latency", plain=0.0),
            dropout=1.0 - (1.0 - settings.dropout) * (1.0 - drawn.number(f"{GROUP}.dropout", plain=0.0)),
        )


def varies(variation: Variation) -> bool:
    """Return whether episodes under a variation draw how they see."""
    return GROUP in variation.groups


def has_drawn(state: InitialState) -> bool:
    """Return whether the episode of an initial state has drawn how it sees; those of older datasets have not."""
    return any(key.startswith(f"{GROUP}.") for key in state)
