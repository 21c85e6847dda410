"""What a task asks about, under its short name: ``gym_demohlm.simulation.worlds``."""

from gym_demohlm.simulation.worlds import Worlds as Worlds
