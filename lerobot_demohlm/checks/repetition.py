"""Stored episodes and a simulation -> their first differences: simulated from their commands, or generated again."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.perception.disturbance import has_drawn
from gym_demohlm.perception.sight import Sight
from gym_demohlm.simulation import Simulation
from gym_demohlm.simulation.judge import held
from gym_demohlm.task import Task
from gym_demohlm.variation import NONE
from lerobot_demohlm.checks.difference import Difference, deviation
from lerobot_demohlm.datasets.episode import Episode
from lerobot_demohlm.datasets.reader import ACTION, ENVIRONMENT_STATE, STATE, SUCCESS, StoredEpisode
from lerobot_demohlm.generation.eyes import open_sight, seen_objects
from lerobot_demohlm.reproducibility import fingerprint
from lerobot_demohlm.reproducibility.fingerprint import Trail


def compare(
    sim: Simulation,
    episodes: Sequence[StoredEpisode],
    bounded: bool = False,
    watch: Callable[[Simulation], None] = lambda sim: None,
    perception: str = "exact",
) -> list[Difference | None]:
    """Repeat episodes as worlds of one simulation, each until it ends or differs.

    Args:
        sim: With at least as many worlds.
        episodes: Of its task, with fingerprints.
        bounded: Whether to go on after a difference, and to measure the deviation of the whole episode.
        watch: Called with the simulation at the start and after every step.
        perception: How objects were seen.

    Returns:
        The first difference of each, None where every bit agrees.
    """
    drawn = any(has_drawn(entry.initial_state) for entry in episodes)
    sight = open_sight(sim, perception, sim.variation if drawn else NONE)
    try:
        return _compared(sim, episodes, bounded, watch, sight)
    finally:
        if sight is not None:
            sight.close()


def _compared(
    sim: Simulation,
    episodes: Sequence[StoredEpisode],
    bounded: bool,
    watch: Callable[[Simulation], None],
    sight: Sight | None,
) -> list[Difference | None]:
    sim.reset([entry.initial_state for entry in episodes], np.arange(len(episodes)))
    watch(sim)
    if sight is not None:
        sight.begin(np.arange(len(episodes)), [entry.initial_state for entry in episodes])
    before = sim.snapshot()
    checks = [_Check(sim.task, entry, world, before, bounded) for world, entry in enumerate(episodes)]
    for step in range(max(len(entry) for entry in episodes)):
        state, environment_state = observation.agent_pos(sim), seen_objects(sim, sight)
        for check in checks:
            check.before(step, state, environment_state)
        going = [check.world for check in checks if check.going(step)]
        if not going:
            break
        commands, active = sim.command, np.zeros(sim.num_worlds, dtype=bool)
        active[going] = True
        commands[going] = [episodes[world].commands[step] for world in going]
        sim.step(commands, active)
        watch(sim)
        if sight is not None:
            sight.look(np.array(going))
        after, success = sim.snapshot(), sim.success()
        for world in going:
            checks[world].after(step, after, success)
    return [check.result() for check in checks]


def compare_again(task: Task, entry: StoredEpisode, made: Episode, bounded: bool = False) -> Difference | None:
    """Compare an episode with its attempt as it was generated again.

    Args:
        task: Of both.
        entry: The episode.
        made: Its attempt.
        bounded: Whether bits may differ, so that the deviation is measured.

    Returns:
        The first difference, None where every bit agrees.
    """
    again = {
        STATE: made.state,
        ENVIRONMENT_STATE: made.environment_state,
        ACTION: made.action,
        SUCCESS: made.success[:, None],
    }
    names = _names(task) | {ACTION: command.NAMES}
    count = min(len(entry), len(made.success))
    first: tuple[int, str, str] | None = None
    for feature, values in again.items():
        kept = entry.columns[feature][:count]
        rows, places = np.nonzero(kept != values[:count])
        if len(rows) and (first is None or rows[0] < first[0]):
            row, place = rows[0], places[0]
            detail = f"{names[feature][place]}: {kept[row, place]} stored, {values[row, place]} generated again"
            first = int(row), feature, detail
    if first is None and (made.outcome != entry.outcome or len(made.success) != len(entry)):
        ends = f"{entry.outcome} after {len(entry)} steps stored, {made.outcome} after {len(made.success)}"
        first = max(count - 1, 0), "outcome", ends
    if first is None and made.digest != entry.digest:
        first = max(count - 1, 0), "digest", "of the whole episode, though every frame agrees"
    if first is None:
        return None
    step, field, detail = first
    measured = None
    if bounded:
        measured = deviation(entry, {name: values[:count] for name, values in again.items()}, made.success[:count])
    return Difference(
        episode=entry.episode, attempt=entry.attempt, step=step, field=field, detail=detail, deviation=measured
    )


def _names(task: Task) -> dict[str, tuple[str, ...]]:
    """Return the names of the dimensions of what is simulated, by feature."""
    return {
        STATE: observation.STATE_NAMES,
        ENVIRONMENT_STATE: observation.environment_names(task),
        SUCCESS: ("success",),
    }


class _Check:
    """One episode against the world that repeats it.

    Args:
        task: The task.
        entry: The episode, with fingerprints.
        world: Which world repeats it.
        start: Snapshot of all worlds before the first action.
        bounded: Whether to go on after a difference.
    """

    def __init__(
        self, task: Task, entry: StoredEpisode, world: int, start: dict[str, np.ndarray], bounded: bool
    ) -> None:
        assert entry.fingerprints is not None  # others are generated again
        self.entry, self.world = entry, world
        self.difference: Difference | None = None
        self._fingerprints, self._bounded, self._broken = entry.fingerprints, bounded, False
        self._trail, self._success = Trail(), []
        self._seen: dict[str, list[np.ndarray]] = {STATE: [], ENVIRONMENT_STATE: []}
        self._names = _names(task)
        if (self._trail.add(start, world) != self._fingerprints[0]).any():
            self._differs(0, "start", "the simulation before the first action")

    def going(self, step: int) -> bool:
        """Tell whether the episode has this step and there is a reason to make it."""
        stopped = self._broken or (self.difference is not None and not self._bounded)
        return not stopped and step < len(self.entry)

    def before(self, step: int, state: np.ndarray, environment_state: np.ndarray) -> None:
        """Compare what is observed before an action, and look at the action itself."""
        for feature, simulated in ((STATE, state), (ENVIRONMENT_STATE, environment_state)):
            if self.going(step):
                self._seen[feature].append(simulated[self.world].copy())
                self._compare(step, feature, simulated)
        if self.going(step):
            broken = np.flatnonzero(~np.isfinite(self.entry.commands[step]))
            if len(broken):
                self._broken = True
                self._differs(step, "action", f"{command.NAMES[broken[0]]} is not a finite number")

    def after(self, step: int, snapshot: dict[str, np.ndarray], success: np.ndarray) -> None:
        """Compare what an action has led to."""
        row = self._trail.add(snapshot, self.world, self.entry.columns[ACTION][step])
        self._success.append(bool(success[self.world]))
        wrong = np.flatnonzero(row != self._fingerprints[step + 1])
        if len(wrong):
            self._differs(step, fingerprint.FIELDS[wrong[0]], "by its fingerprint")
        else:
            self._compare(step, SUCCESS, success[:, None])

    def result(self) -> Difference | None:
        """Compare what counts for the episode as a whole; returns its first difference."""
        last = max(len(self.entry) - 1, 0)
        if self.difference is None and self._trail.digest != self.entry.digest:
            self._differs(last, "digest", "of the whole episode, though every step agrees")
        if self.difference is None and self.entry.outcome == "success" and not held(self._success):
            self._differs(last, "outcome", "success stored, but it did not hold for the last second")
        count = len(self._success)
        if self.difference is None or not self._bounded or count == 0:
            return self.difference
        seen = {name: np.array(rows[:count]).reshape(count, -1) for name, rows in self._seen.items()}
        return replace(self.difference, deviation=deviation(self.entry, seen, self._success))

    def _compare(self, step: int, feature: str, simulated: np.ndarray) -> None:
        """Compare a frame of a feature, whose rows are worlds, bit for bit."""
        kept, value = self.entry.columns[feature][step], simulated[self.world]
        if self.difference is not None or kept.tobytes() == value.tobytes():
            return
        first = next(i for i in range(len(kept)) if kept[i].tobytes() != value[i].tobytes())
        self._differs(step, feature, f"{self._names[feature][first]}: {kept[first]} stored, {value[first]} simulated")

    def _differs(self, step: int, field: str, detail: str) -> None:
        """Note a difference, if it is the first."""
        if self.difference is None:
            self.difference = Difference(
                episode=self.entry.episode, attempt=self.entry.attempt, step=step, field=field, detail=detail
            )
