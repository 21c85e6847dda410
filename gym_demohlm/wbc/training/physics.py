"""States and motor targets of N training worlds -> the states and sensor readings a control tick later, on CPU cores.

``RolloutPhysics`` is mujoco.rollout; ``warp_physics.WarpPhysics`` does the same on a GPU. Both are a ``Physics``.
"""

from collections.abc import Sequence
from typing import Protocol, cast

import mujoco
import numpy as np
from mujoco import rollout

from gym_demohlm.errors import SceneError

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


class Physics(Protocol):
    """Steps N worlds that share a few randomised models; world ``i`` begins with model ``i % len(models)``."""

    def assign(self, worlds: np.ndarray, models: np.ndarray) -> bool:
        """Give worlds (n,) other models, by their indices (n,); returns whether this physics can."""
        ...

    def step(self, state: np.ndarray, control: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Advance all worlds, the constraint solver started cold.

        Args:
            state: (N, mj_stateSize of STATE): time, qpos, qvel.
            control: (N, substeps, nu) motor targets of each physics step [rad].

        Returns:
            The states after the last substep, and the sensor readings (N, nsensordata) that its forces were found with,
            which are those of the moment before: as ``mj_step`` leaves them. New float64 arrays.
        """
        ...


def check_models(models: Sequence[mujoco.MjModel]) -> None:
    """Check that models can share worlds: one layout of states, motors and sensors, no activations.

    Raises:
        SceneError: There is no model, or they differ.
    """
    layouts = {(m.nq, m.nv, m.na, m.nu, m.nbody, m.ngeom, m.nsensordata, mujoco.mj_stateSize(m, STATE)) for m in models}
    if len(layouts) != 1 or models[0].na:
        got = f"{len(models)} models of {len(layouts)} layouts" + (
            ", with activations" if models and models[0].na else ""
        )
        raise SceneError(got, "models that differ in numbers alone, with plain motors", "build them from one spec")


class RolloutPhysics:
    """N worlds on CPU threads.

    Args:
        models: Randomised models.
        num_worlds: N.
        num_threads: Threads of mujoco.rollout.
    """

    def __init__(self, models: Sequence[mujoco.MjModel], num_worlds: int, num_threads: int = 1) -> None:
        check_models(models)
        self._choice = list(models)
        self._models = [models[world % len(models)] for world in range(num_worlds)]
        self._rollout = rollout.Rollout(nthread=num_threads)
        self._data = [mujoco.MjData(models[0]) for _ in range(num_threads)]

    def assign(self, worlds: np.ndarray, models: np.ndarray) -> bool:
        """Give worlds other models; see ``Physics``."""
        for world, model in zip(worlds, models, strict=True):
            self._models[world] = self._choice[model]
        return True

    def step(self, state: np.ndarray, control: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Advance all worlds; see ``Physics``."""
        states, sensors = cast(
            tuple[np.ndarray, np.ndarray], self._rollout.rollout(self._models, self._data, state, control)
        )
        return states[:, -1].copy(), sensors[:, -1].copy()


def make_physics(
    models: Sequence[mujoco.MjModel], num_worlds: int, substeps: int, *, num_threads: int, warp_device: str | None
) -> Physics:
    """Return mujoco_warp on ``warp_device``, or mujoco.rollout where that is None.

    Raises:
        SceneError: The models cannot share worlds, or there is no such device.
    """
    check_models(models)
    if warp_device is None:
        return RolloutPhysics(models, num_worlds, num_threads)
    from gym_demohlm.wbc.training.warp_physics import WarpPhysics  # slow to import, and no use without a GPU

    return WarpPhysics(models, num_worlds, substeps, warp_device)
