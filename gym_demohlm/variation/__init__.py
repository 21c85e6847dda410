"""How a world differs from the plain one: ranges by name, what an episode draws from them, and what that changes."""

from gym_demohlm.variation.conditions import Conditions as Conditions
from gym_demohlm.variation.variation import NONE as NONE
from gym_demohlm.variation.variation import Variation as Variation
from gym_demohlm.variation.variation import get_variation as get_variation
