"""Ways to generate training data, and digests of what generation makes of a task in its worlds."""

import functools
import re
from collections.abc import Mapping

from gym_demohlm.registry import get_task
from gym_demohlm.task import DEFAULT_REGION, WIDEST
from gym_demohlm.variation import get_variation
from lerobot_demohlm.checks import portability
from lerobot_demohlm.datasets import variation
from lerobot_demohlm.datasets.facts import perception_fit
from lerobot_demohlm.datasets.variation import DataVariation

PLAIN = "plain"  # what lines without a variant are of, and what the table of regions counts
DEFAULT_VARIANT = "noise"  # what policies are trained on: the best in the ablation
VARIANTS: Mapping[str, DataVariation] = {
    PLAIN: variation.PLAIN,
    "noise": DataVariation(command_noise=1.0),
    "starts": DataVariation(command_noise=0.0, start_spread=1.3),
    "stances": DataVariation(command_noise=0.0, stance_spread=1.0),
    "noise_stances": DataVariation(command_noise=1.0, stance_spread=1.0),
    "real": DataVariation(command_noise=1.0, variation="real"),
    "model": DataVariation(command_noise=1.0, perception="model"),
}
"""Ways to generate training data, each said in full; rollouts are the same for all of them."""


@functools.cache
def stamp(task: str, *variations: str, region: str = DEFAULT_REGION) -> str:
    """Return letters that change with what generation does with a task, wherever its code stands.

    Args:
        task: Name of the task.
        variations: Of the worlds that a result is of, of its training data and its rollouts; "none" adds nothing.
        region: Where attempts start.

    Returns:
        Eight letters of the task and eight of each preset that its worlds vary by. In R4 eight more: of a task without
        tables, of how hands keep clear of their shoulders; of one with tables in worlds that vary, of how attempts keep
        clear of these, and again eight where a hand pushes a thing onto the other's palm.
    """
    presets = sorted({re.split("[@:]", name)[0] for name in variations if get_variation(name)})
    recipes = [portability.stamp(get_task(task)), *map(portability.recipe, presets)]
    if region == WIDEST and not get_task(task).supports:
        recipes.append(portability.shoulder_recipe())
    elif region == WIDEST and presets:
        recipes.append(portability.table_recipe())
        if portability.hands_over(task):
            recipes.append(portability.handing_over_recipe())
    return "".join(recipes)


def sight(variant: str) -> tuple[str, str]:
    """Return variation and perception of the training data of a variant."""
    return VARIANTS[variant].variation, VARIANTS[variant].perception


def sight_stamp(task: str, *worlds: tuple[str, str], region: str = DEFAULT_REGION) -> str:
    """Return ``stamp`` and letters that change with the errors by which objects are seen, where a fit says these.

    Args:
        task: Name of the task.
        worlds: Variation and perception of a result's training data, and of its rollouts.
        region: Where attempts start.
    """
    data = [DataVariation(variation=variation, perception=perception) for variation, perception in worlds]
    fits = sorted({perception_fit(get_task(task), entry.content())[:8] for entry in data})
    return stamp(task, *(variation for variation, _ in worlds), region=region) + "".join(fits)
