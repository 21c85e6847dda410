"""A simulated robot -> which parts of it touch each other, for warnings."""

import mujoco

from gym_demohlm.simulation import Simulation


class SelfContacts:
    """Finds parts of the robot that touch each other."""

    def __init__(self, sim: Simulation) -> None:
        self._sim, self._model = sim, sim.scene.physics
        self._data = mujoco.MjData(self._model)
        body = self._model.geom_bodyid
        self._robot = self._model.body_rootid[body] == self._model.body_rootid[self._model.body("pelvis").id]

    def look(self) -> list[tuple[str, str]]:
        """Return the names of bodies that touch each other now."""
        self._data.qpos[:] = self._sim.qpos[0]
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        pairs = set()
        contacts = self._data.contact
        for first, second in contacts.geom[contacts.dist < 0.0].tolist():
            if self._robot[first] and self._robot[second]:
                names = sorted(_plain(self._model.body(self._model.geom_bodyid[geom]).name) for geom in (first, second))
                if names[0] != names[1]:
                    pairs.add((names[0], names[1]))
        return sorted(pairs)


def _plain(body: str) -> str:
    return body.removesuffix("_link").replace("_", " ")
