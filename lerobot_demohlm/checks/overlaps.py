"""A simulation, stepped -> how deep things of the task were inside each other or the robot, and which."""

from dataclasses import dataclass

import numpy as np

from gym_demohlm.simulation import Simulation
from gym_demohlm.timing import CONTROL_DT


@dataclass(frozen=True, kw_only=True, order=True)
class Overlap:
    """Two things inside each other; the deeper one is the greater one.

    Attributes:
        depth: [m].
        where: Their names, the time and the world.
    """

    depth: float = 0.0
    where: str = "no contact"


class OverlapWatch:
    """Keeps the deepest contact of anything that the task added to a simulation; it looks at every controller tick.

    Args:
        sim: The simulation; its ``on_tick`` calls ``look`` from now on.

    Attributes:
        deepest: The deepest overlap at any look.
        lasting: The deepest overlap at two looks in a row, 0.02 s apart; its depth is the lesser one of the two. What
            the trunk touches does not count: a robot that falls on a light cube squeezes it with its whole weight.
    """

    def __init__(self, sim: Simulation) -> None:
        self.deepest = self.lasting = Overlap()
        self._sim = sim
        self._before: list[dict[tuple[int, int], float]] = [{} for _ in range(sim.num_worlds)]  # depth by pair of geoms
        self._looked_at = np.full(sim.num_worlds, np.nan)  # s, time of the last look
        model = sim.model
        robot = model.body_rootid[model.body("pelvis").id]
        # Robot and floor alone are the controller's matter; a contact counts where a task's body takes part.
        self._added = model.body_rootid[model.geom_bodyid] != robot
        self._added[model.geom("floor").id] = False
        self._bodies = model.geom_bodyid
        self._moves = model.body_dofnum[self._bodies] > 0
        self._trunk = self._bodies == model.body("torso_link").id

        sim.on_tick = lambda worlds, _commands: self.look(worlds)

    def look(self, worlds: np.ndarray) -> None:
        """Look at the contacts of some worlds now."""
        time = self._sim.time
        for world in worlds:
            if not abs(time[world] - self._looked_at[world] - CONTROL_DT) < 0.5 * CONTROL_DT:
                self._before[world] = {}  # a reset or a pause lies between the looks
            self._looked_at[world] = time[world]
            contacts = self._sim.mj_data(int(world)).contact
            now: dict[tuple[int, int], float] = {}
            under_trunk = self._under_trunk(contacts.geom[contacts.dist < 0.0])
            for (first, second), distance in zip(contacts.geom.tolist(), contacts.dist.tolist(), strict=True):
                if distance < 0.0 and (self._added[first] or self._added[second]):
                    now[first, second] = max(-distance, now.get((first, second), 0.0))
            for pair, depth in now.items():
                lasting = min(depth, self._before[world].get(pair, 0.0))
                if depth > self.deepest.depth:
                    self.deepest = self._overlap(depth, pair, world)
                if lasting > self.lasting.depth and under_trunk.isdisjoint(self._bodies[list(pair)].tolist()):
                    self.lasting = self._overlap(lasting, pair, world)
            self._before[world] = now

    def _under_trunk(self, pairs: np.ndarray) -> set[int]:
        """Return the bodies of movable things that the trunk touches, of pairs (N, 2) of geoms."""
        touched = pairs[self._trunk[pairs].any(axis=1)].ravel()
        return set(self._bodies[touched[self._added[touched] & self._moves[touched]]].tolist())

    def _overlap(self, depth: float, pair: tuple[int, int], world: int) -> Overlap:
        names = " in ".join(self._sim.model.geom(geom).name or self._body_name(geom) for geom in pair)
        return Overlap(depth=depth, where=f"{names} at {self._sim.time[world]:.2f} s in world {world}")

    def _body_name(self, geom: int) -> str:
        model = self._sim.model
        return model.body(model.geom_bodyid[geom]).name
