"""States and motor targets of N training worlds -> the states and sensor readings a control tick later, on a GPU.

mujoco_warp in float32, with NumPy float64 at the border. It also runs on the CPU, slowly: what the tests do.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from gym_demohlm.errors import SceneError

_ROWS_PER_CONTACT = 4  # of a pyramidal friction cone in three dimensions
_PLANE, _SPHERE, _BOX = map(int, (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_BOX))
_CONTACTS = {(_PLANE, _SPHERE): 1, (_SPHERE, _SPHERE): 1, (_SPHERE, _BOX): 1, (_PLANE, _BOX): 4}  # at most
_MOST_CONTACTS = 8  # of two boxes, and of whatever else
_UNUSED = ("dof_length",)  # shared, differ with the masses, and are read for bodies that may sleep alone: none may


class WarpPhysics:
    """N worlds on a device of warp.

    Args:
        models: Randomised models that ``physics.check_models`` accepts; they may differ in what mujoco_warp keeps for
            each world: masses, inertias, friction, gains, not in sizes or options.
        num_worlds: N.
        substeps: Physics steps a control tick, recorded as one CUDA graph.
        device: ``cuda``, ``cuda:1``, ..., ``cpu``.

    Raises:
        SceneError: The models differ in something that worlds must share, or there is no such device.
    """

    def __init__(self, models: Sequence[mujoco.MjModel], num_worlds: int, substeps: int, device: str = "cuda") -> None:
        self._device = _device(device)
        first = models[0]
        self._nq = first.nq
        contacts, rows = (max(most) for most in zip(*map(most_contacts_and_rows, models), strict=True))
        with wp.ScopedDevice(self._device):
            self._model = _merge(models)
            self._data = mjw.make_data(first, nworld=num_worlds, nconmax=contacts, njmax=rows)
            self._control = [wp.zeros((num_worlds, first.nu), dtype=float) for _ in range(substeps)]
            self._graph = None
            if self._device.is_cuda:
                self._advance()  # compiles every kernel, which a recording must not
                with wp.ScopedCapture() as capture:
                    self._advance()
                self._graph = capture.graph

    def _advance(self) -> None:
        self._data.qacc_warmstart.zero_()  # as mujoco.rollout: a tick is a function of state and control alone
        for control in self._control:
            wp.copy(self._data.ctrl, control)
            mjw.step(self._model, self._data)

    def assign(self, worlds: np.ndarray, models: np.ndarray) -> bool:
        """Keep every world's model: they are laid out on the device once; see ``Physics``."""
        return False

    def step(self, state: np.ndarray, control: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Advance all worlds; see ``Physics``."""
        data, position_end = self._data, 1 + self._nq
        with wp.ScopedDevice(self._device):
            data.time.assign(state[:, 0])
            data.qpos.assign(state[:, 1:position_end])
            data.qvel.assign(state[:, position_end:])
            for substep, array in enumerate(self._control):
                array.assign(control[:, substep])
            if self._graph is None:
                self._advance()
            else:
                wp.capture_launch(self._graph)
            arrived = np.concatenate([data.time.numpy()[:, None], data.qpos.numpy(), data.qvel.numpy()], axis=1)
            return arrived.astype(np.float64), data.sensordata.numpy().astype(np.float64)


def most_contacts_and_rows(model: mujoco.MjModel) -> tuple[int, int]:
    """Return how many contacts, and how many rows of constraints, a world may have: what exceeds them is left out.

    A pair of geoms that may touch counts with all its contacts, a joint with one limit and, where it has any, its dry
    friction.
    """
    touching = np.flatnonzero(model.geom_contype | model.geom_conaffinity).tolist()
    pairs = [(int(a), int(b)) for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)]
    for one, other in itertools.combinations(touching, 2):
        meet = model.geom_contype[one] & model.geom_conaffinity[other]
        meet |= model.geom_contype[other] & model.geom_conaffinity[one]
        apart = model.body_weldid[model.geom_bodyid[one]] != model.body_weldid[model.geom_bodyid[other]]
        if meet and apart:
            pairs.append((one, other))
    types = [(int(model.geom_type[one]), int(model.geom_type[other])) for one, other in pairs]
    contacts = sum(_CONTACTS.get((min(pair), max(pair)), _MOST_CONTACTS) for pair in types)
    limits, friction = np.count_nonzero(model.jnt_limited), np.count_nonzero(model.dof_frictionloss)
    return contacts, _ROWS_PER_CONTACT * contacts + int(limits + friction)


def _device(name: str) -> wp.Device:
    wp.init()
    available = [device.alias for device in wp.get_devices()]
    try:
        return wp.get_device(name)
    except (ValueError, RuntimeError) as error:
        raise SceneError(f"device {name!r}", f"one of {', '.join(available)}", "choose another --device") from error


def _merge(models: Sequence[mujoco.MjModel]) -> mjw.Model:
    """Put models on the device as one, its fields as long as there are models wherever these differ.

    mujoco_warp reads such a field for world ``i`` at ``i % length``.
    """
    parts = [mjw.put_model(model) for model in models]
    for group in (lambda part: part, lambda part: part.opt, lambda part: part.stat):
        _merge_fields([group(part) for part in parts])
    return parts[0]


def _merge_fields(parts: Sequence[Any]) -> None:
    """Make the fields of the first part stand for all parts."""
    for field in dataclasses.fields(parts[0]):
        values = [getattr(part, field.name) for part in parts]
        if field.name in _UNUSED or not isinstance(values[0], wp.array):
            continue
        arrays = [value.numpy() for value in values]
        if all(np.array_equal(array, arrays[0]) for array in arrays):
            continue
        if getattr(field.type, "shape", (None,))[0] != "*":
            raise SceneError(
                f"models that differ in {field.name}", "models that differ in numbers each world may have", "share it"
            )
        setattr(parts[0], field.name, wp.array(np.concatenate(arrays), dtype=values[0].dtype))
