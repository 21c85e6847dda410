"""A batch of observations -> one whose rows are a multiple of 16, and the actions for it back to the rows there were.

A matrix product may round a row differently in another number of rows, and a rollout with contacts makes another
episode of the last bit. In blocks of 16 rows MLP and ACT give each row the same bits, whatever is in the others, so a
policy's episode depends on its seed and not on how many are rolled out together, here and in ``lerobot-eval``. (Of a
layer narrower than 16, which no preset has, some processors round a row by its place all the same.)
"""

from dataclasses import dataclass, field
from typing import Any, cast

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import PolicyProcessorPipeline, ProcessorStep
from lerobot.utils.constants import OBS_IMAGES

BLOCK = 16  # rows
_Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]


@dataclass
class FillRowsStep(ProcessorStep):
    """Fills a batch of observations up with copies of its first row; images are left as they are, for their cost."""

    num_rows: int = field(default=0, init=False)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Fill up the observations and the texts of the task."""
        observation = dict(transition.get(TransitionKey.OBSERVATION) or {})
        self.num_rows = next((len(value) for value in observation.values()), 0)
        missing = -self.num_rows % BLOCK
        if missing == 0 or any(key.startswith(OBS_IMAGES) for key in observation):
            return transition
        filled: dict[Any, Any] = {**transition}
        filled[TransitionKey.OBSERVATION] = {
            key: torch.cat([value, value[:1].expand(missing, *value.shape[1:])]) for key, value in observation.items()
        }
        texts: dict[str, Any] = dict(transition.get(TransitionKey.COMPLEMENTARY_DATA) or {})
        filled[TransitionKey.COMPLEMENTARY_DATA] = {
            key: value + value[:1] * missing if isinstance(value, list) else value for key, value in texts.items()
        }
        return cast(EnvTransition, filled)

    def transform_features(self, features: _Features) -> _Features:
        """Return the features: a row is what it was."""
        return features


@dataclass
class CutRowsStep(ProcessorStep):
    """Keeps the actions of the rows that there were.

    Args:
        filled: The step that has seen them.
    """

    filled: FillRowsStep

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Cut the actions."""
        cut: dict[Any, Any] = {**transition}
        cut[TransitionKey.ACTION] = cut[TransitionKey.ACTION][: self.filled.num_rows]
        return cast(EnvTransition, cut)

    def transform_features(self, features: _Features) -> _Features:
        """Return the features: a row is what it was."""
        return features


def row_processors() -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Return what an environment does to a policy's observations and to its actions."""
    fill = FillRowsStep()
    return PolicyProcessorPipeline(steps=[fill]), PolicyProcessorPipeline(steps=[CutRowsStep(fill)])
