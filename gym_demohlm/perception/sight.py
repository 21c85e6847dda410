"""A perceiver -> what all worlds of a simulation seem to show: their observation, and where the neck turns."""

import hashlib
import json
from collections.abc import Sequence

import numpy as np

from gym_demohlm.perception.disturbance import Disturbance
from gym_demohlm.perception.disturbed import DisturbedPerceiver
from gym_demohlm.perception.estimate import PoseEstimate, faults_of
from gym_demohlm.perception.looking import LookAround
from gym_demohlm.perception.perceiver import make_perceiver
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import InitialState
from gym_demohlm.variation import Conditions, Variation


class Sight:
    """Looks once a step and remembers what it saw; its estimate of the gaze target drives the neck.

    A neck first looks around for those objects of the task that it has to search (``Task.searched``).

    What is random in an episode's eyes is a function of where the episode starts, so an episode sees the same alone and
    among others.

    Args:
        sim: The worlds.
        settings: See ``make_perceiver``.
        variation: By which episodes draw how they see; that of the worlds by default.

    Raises:
        UnknownNameError: There is no such source.
    """

    def __init__(self, sim: Simulation, settings: str | PerceptionSettings, variation: Variation | None = None) -> None:
        self._sim = sim
        self._settings = PerceptionSettings.read(settings)
        variation = sim.variation if variation is None else variation
        self._perceiver = make_perceiver(self._settings, sim.task, sim.num_worlds, variation)
        shape = sim.num_worlds, len(sim.task.objects)
        self._estimate = PoseEstimate(
            T_camera_object=np.tile(np.eye(4), (*shape, 1, 1)),
            valid=np.zeros(shape, bool),
            age_s=np.full(shape, np.inf),
            inliers=np.zeros(shape),
        )
        self._gaze = [entry.name for entry in sim.task.objects].index(sim.task.gaze_target)
        self._around = LookAround(sim.task, sim.num_worlds)

    @property
    def estimate(self) -> PoseEstimate:
        """What was seen last in each world."""
        return self._estimate

    def begin(self, rows: np.ndarray, initial_states: Sequence[InitialState]) -> None:
        """Begin episodes in some worlds (n,) and look at them."""
        self._perceiver.begin(rows, [_seed(state) for state in initial_states])
        self._around.begin(rows)
        if isinstance(self._perceiver, DisturbedPerceiver):
            drawn = [Disturbance.of(self._settings, Conditions.read(state)) for state in initial_states]
            self._perceiver.disturb(rows, drawn)
        self.look(rows)

    def look(self, rows: np.ndarray) -> None:
        """Look at some worlds (n,), after their step."""
        if len(rows) == 0:
            return
        seen = self._perceiver.observe(self._sim, rows)
        for name in ("T_camera_object", "valid", "age_s", "inliers"):
            getattr(self._estimate, name)[rows] = getattr(seen, name)
        told, before = self._estimate.position(self._gaze), self._sim.p_camera_gaze
        p_camera_gaze = told if before is None else before.copy()  # a glance of another world goes on
        p_camera_gaze[rows] = self._around.targets(self._sim, rows, told[rows], self._estimate.age_s[rows])
        self._sim.p_camera_gaze = p_camera_gaze

    def environment_state(self) -> np.ndarray:
        """Return the observation of all worlds (N, 9k) float32."""
        return self._estimate.environment_state()

    def faults(self, row: int) -> dict[str, int]:
        """Return how often what went wrong with the eyes in the episode of a world, by its reason."""
        return faults_of(self._perceiver, row)

    def close(self) -> None:
        """Give back what the perceiver holds; the neck sees exactly again."""
        self._sim.p_camera_gaze = None
        self._perceiver.close()


def _seed(state: InitialState) -> int:
    """Return a seed that is a function of where an episode starts."""
    digest = hashlib.sha256(json.dumps(state, sort_keys=True).encode()).digest()
    return int.from_bytes(digest[:7], "little")
