"""Short name of ``gym_demohlm.simulation.worlds``: what the predicates of a task ask."""

from gym_demohlm.simulation.worlds import Worlds as Worlds
