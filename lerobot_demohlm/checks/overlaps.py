"""A task's worlds, stepped -> how deep things of the task were inside each other or the robot, and which."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gym_demohlm.simulation import Simulation
from gym_demohlm.task import InitialState, Task


@dataclass(frozen=True, kw_only=True, order=True)
class Overlap:
    """Two things inside each other; the deeper one is the greater one.

    Attributes:
        depth: [m].
        where: Their names, the time and the world.
    """

    depth: float = 0.0
    where: str = "no contact"


class WatchedSimulation(Simulation):
    """A simulation that keeps the deepest contact of anything that the task added, looked for at every tick.

    Attributes:
        deepest: At any look.
        lasting: At two looks in a row, 0.02 s apart; the lesser depth of the two.
    """

    def __init__(self, task: Task, num_worlds: int = 1) -> None:
        self.deepest = self.lasting = Overlap()
        self._before: list[dict[tuple[int, int], float]] = [{} for _ in range(num_worlds)]  # depth by pair of geoms
        super().__init__(task, num_worlds)
        model = self.model
        robot = model.body_rootid[model.body("pelvis").id]
        # Robot and floor alone are the controller's matter; a contact counts where a task's body takes part.
        self._added = model.body_rootid[model.geom_bodyid] != robot
        self._added[model.geom("floor").id] = False

    def reset(self, initial_states: Sequence[InitialState], worlds: np.ndarray | None = None) -> None:
        """Begin episodes, in which nothing has lasted yet."""
        for world in range(self.num_worlds) if worlds is None else worlds:
            self._before[world] = {}
        super().reset(initial_states, worlds)

    def watch(self, worlds: np.ndarray) -> None:
        """Look at the contacts of some worlds now."""
        for world in worlds:
            contacts = self.mj_data(int(world)).contact
            now: dict[tuple[int, int], float] = {}
            for (first, second), distance in zip(contacts.geom.tolist(), contacts.dist.tolist(), strict=True):
                if distance < 0.0 and (self._added[first] or self._added[second]):
                    now[first, second] = max(-distance, now.get((first, second), 0.0))
            for pair, depth in now.items():
                lasting = min(depth, self._before[world].get(pair, 0.0))
                if depth > self.deepest.depth:
                    self.deepest = self._overlap(depth, pair, world)
                if lasting > self.lasting.depth:
                    self.lasting = self._overlap(lasting, pair, world)
            self._before[world] = now

    def _tick(self, tick: int, rows: np.ndarray, commands: np.ndarray) -> np.ndarray:
        sound = super()._tick(tick, rows, commands)
        self.watch(sound)
        return sound

    def _overlap(self, depth: float, pair: tuple[int, int], world: int) -> Overlap:
        names = " in ".join(self.model.geom(geom).name or self._body_name(geom) for geom in pair)
        return Overlap(depth=depth, where=f"{names} at {self.time[world]:.2f} s in world {world}")

    def _body_name(self, geom: int) -> str:
        return self.model.body(self.model.geom_bodyid[geom]).name
