"""N worlds of one task that are stepped together, kept and restored."""

from gym_demohlm.simulation.simulation import Controller as Controller
from gym_demohlm.simulation.simulation import Pool as Pool
from gym_demohlm.simulation.simulation import Simulation as Simulation
from gym_demohlm.simulation.simulation import StepResult as StepResult
from gym_demohlm.simulation.simulation import make_pool as make_pool
from gym_demohlm.simulation.worlds import Worlds as Worlds
