"""Proprioception and commands -> joint targets at 50 Hz: the trained whole-body controller, batched, NumPy only.

A world's targets have the same bits whether it is computed alone or in a batch, and on every processor: the network's
products are exact (``arithmetic.ExactProduct``).
"""

import hashlib
import io
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.arithmetic import ExactProduct
from gym_demohlm.control import arm_load, command, features, gait_clock, reference
from gym_demohlm.control.kernels import network
from gym_demohlm.control.kernels import tick as kernels
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.control.settings import Settings
from gym_demohlm.control.tick import LAST_ACTION, SLEWED, STANDING, STATE_SIZE, Sensors, Tick
from gym_demohlm.errors import SceneError
from gym_demohlm.robot import g1
from gym_demohlm.robot.physics import Physics

WEIGHTS_FOLDER = Path(__file__).parent / "weights"
DEFAULT_NAME = WEIGHTS_FOLDER / "default.txt"
"""Names the default controller's file."""
DEFAULT_WEIGHTS = WEIGHTS_FOLDER / f"{DEFAULT_NAME.read_text().strip()}.npz"
WEIGHTS_FORMAT = 5
_FORMATS = dict(zip((4, WEIGHTS_FORMAT), features.OBSERVATION_SIZES, strict=True))
_TABLES = (len(reference.TABLE_HEIGHTS), len(reference.TABLE_PITCHES), 5), arm_load.TABLE_SHAPE
_ARMS = slice(reference.NUM_LOWER, None)  # of the body joints
_LARGEST_INPUT = 6.0  # deviations from the mean: what training clips observations to
_LARGEST_HIDDEN = 64.0  # of a hidden unit: far above what occurs


class Weights:
    """The exported policy: layers, normaliser, quasi-static tables, settings and metadata.

    Args:
        path: An ``.npz`` written by ``gym_demohlm.wbc.training.export``. Nothing in it is executed or unpickled.

    Attributes:
        metadata: How it was trained and what it expects.
        settings: What it is besides its network.
        symmetric: Whether it was trained as the mean of itself and its mirror image.
        use_reference: Whether it corrects the reference pose; otherwise that of rest.
        hash: SHA-256 of the file.

    Raises:
        SceneError: The file is missing, damaged, of another format, or holds numbers that are not finite.
    """

    def __init__(self, path: Path = DEFAULT_WEIGHTS) -> None:
        content, self.metadata, arrays = read_arrays(path)
        self.settings = Settings.read(self.metadata)
        self.symmetric: bool = self.metadata.get("symmetric", True)
        self.use_reference: bool = self.metadata.get("use_reference", True)
        self.layers = [
            (ExactProduct(arrays[f"weight_{i}"], _LARGEST_HIDDEN if i else _LARGEST_INPUT), arrays[f"bias_{i}"])
            for i in range(int(self.metadata["layers"]))
        ]
        self.mean, self.scale = arrays["mean"], arrays["scale"]
        self._tables = arrays["posture_table"], arrays["arm_table"]
        self.hash = hashlib.sha256(content).hexdigest()

    def make_reference(self) -> reference.Reference:
        """Return the reference pose that the policy corrects."""
        kind = reference.Reference if self.use_reference else reference.Rest
        return kind(*self._tables, self.settings.gait)


def read_arrays(path: Path) -> tuple[bytes, dict[str, Any], dict[str, np.ndarray]]:
    """Read and check a weights file of this or an earlier format.

    Args:
        path: Of the file.

    Returns:
        Its content, its metadata, and its arrays, float64.

    Raises:
        SceneError: As ``Weights``.
    """
    try:
        content = path.read_bytes()
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            text = file["metadata"].tobytes()
            arrays = {name: file[name].astype(np.float64) for name in file.files if name != "metadata"}
        metadata: dict[str, Any] = json.loads(text)
        found = (metadata["format"], metadata["observation_size"])
        layers = [(arrays[f"weight_{i}"], arrays[f"bias_{i}"]) for i in range(int(metadata["layers"]))]
        sizes = [len(arrays["mean"]), *(len(bias) for _, bias in layers)]
        shapes = [weight.shape for weight, _ in layers] + [arrays["scale"].shape]
        tables = arrays["posture_table"].shape, arrays["arm_table"].shape
    except Exception as error:  # readers of zip files raise anything
        raise SceneError(
            f"controller weights {path.name} that cannot be read ({error})",
            "an .npz file exported by demohlm train-controller",
            "reinstall the package, or export the weights again",
        ) from error
    if found not in _FORMATS.items():
        raise SceneError(
            f"controller weights of format {found[0]} for {found[1]} observations",
            " or ".join(f"format {number} for {size}" for number, size in _FORMATS.items()),
            "train or install weights for this version",
        )
    expected = [*pairwise(sizes), (sizes[0],)]
    if sizes[0] != found[1] or sizes[-1] != features.ACTION_SIZE or shapes != expected or tables != _TABLES:
        raise SceneError(
            f"controller weights {path.name} with layers of {shapes} and tables of {tables}",
            f"layers that fit, from {found[1]} to {features.ACTION_SIZE}, and tables of {_TABLES}",
            "export the weights again",
        )
    bad = sorted(name for name, values in arrays.items() if not np.isfinite(values).all())
    if bad:
        raise SceneError(
            f"controller weights {path.name} with NaN or infinity in {', '.join(bad)}",
            "finite numbers",
            "export an earlier checkpoint of that training",
        )
    return content, metadata, arrays


class WholeBodyController:
    """N whole-body controllers.

    Args:
        num_worlds: N.
        weights: File of the exported policy; the one in the package by default.

    Attributes:
        state: (N, STATE_SIZE) all that the controllers remember; assign to it to restore an earlier moment.
    """

    def __init__(self, num_worlds: int, weights: Path | None = None) -> None:
        self.weights = Weights(weights or DEFAULT_WEIGHTS)
        self.reference = self.weights.make_reference()
        self._tick = Tick(self.reference, self.weights.settings)
        self.state = np.zeros((num_worlds, STATE_SIZE))
        self._lower, self._upper = np.ascontiguousarray(g1.joint_ranges(g1.read_mjcf()).T)
        self._numbers = kernels.Numbers.of(self.reference, self.settings)
        self._mirrors = features.OBSERVATION_MIRROR, features.ACTION_MIRROR
        if not self.weights.symmetric:
            self._mirrors = features.no_mirror(features.OBSERVATION_SIZE), features.no_mirror(features.ACTION_SIZE)

    @property
    def settings(self) -> Settings:
        """What it is besides its network: the settings of the weights, until assigned."""
        return self._tick.settings

    @settings.setter
    def settings(self, settings: Settings) -> None:
        self.reference.gait = settings.gait
        self._tick = Tick(self.reference, settings)
        self._numbers = kernels.Numbers.of(self.reference, settings)

    @property
    def physics(self) -> Physics:
        """Of the robot that it was trained for."""
        return self._tick.settings.physics

    @property
    def last_action(self) -> np.ndarray:
        """What the policies did in the last tick, (N, 15)."""
        return self.state[:, LAST_ACTION].copy()

    @property
    def cycle_s(self) -> float:
        """Period of the gait [s]."""
        return self.reference.gait.period_s

    @property
    def standing(self) -> np.ndarray:
        """Whose clocks rest, (N,) bool."""
        return self.state[:, STANDING] > 0.5

    @property
    def slewed(self) -> np.ndarray:
        """The command as far as it has been slewed, (N, 7)."""
        return self.state[:, SLEWED].copy()

    def reset(self, worlds: np.ndarray, sensed: Proprioception) -> None:
        """Start the controllers of some worlds anew, standing at rest.

        Args:
            worlds: (M,) indices.
            sensed: What the robots of these worlds sense, M rows.
        """
        sensors, count = Sensors.of(sensed), len(worlds)
        slewed = np.tile(command.rest()[:7], (count, 1))
        arms = sensors.q[:, reference.NUM_LOWER :]
        self.state[worlds] = self._tick.start(sensors, slewed, gait_clock.at_rest(count), arms)

    def step(self, sensed: Proprioception, commands: np.ndarray, worlds: np.ndarray | None = None) -> np.ndarray:
        """Advance by one tick of 0.02 s.

        Args:
            sensed: What M robots sense; of the pelvis orientation only the direction of gravity is used.
            commands: (M, 23) within their bounds; velocity and torso are slewed here, arms pass through.
            worlds: (M,) which worlds these rows belong to; all by default.

        Returns:
            Joint targets (M, 29) [rad].
        """
        chosen = slice(None) if worlds is None else worlds
        before, count = self.state[chosen], len(sensed)
        after, told, attitude = np.empty_like(before), np.empty((count, 7)), np.empty((count, 4))
        observed, targets = np.empty((count, features.OBSERVATION_SIZE)), np.empty((count, len(self._lower)))
        quat_wxyz, gyro = np.ascontiguousarray(sensed.quat_wxyz), np.ascontiguousarray(sensed.gyro)
        q, dq, commands = (np.ascontiguousarray(rows) for rows in (sensed.q, sensed.dq, commands))
        kernels.perceive(
            self._numbers, before, quat_wxyz, gyro, q, dq, commands, command.ARMS.start, after, observed, told, attitude
        )  # fmt: skip
        action = self._act(observed)
        kernels.targets(self._numbers, after, told, attitude, action, self._lower, self._upper, targets)
        self.state[chosen] = after
        np.clip(commands[:, command.ARMS], self._lower[_ARMS], self._upper[_ARMS], out=targets[:, _ARMS])
        return targets

    def _act(self, observed: np.ndarray) -> np.ndarray:
        """Return the policy's mean action within its limit, (M, OBSERVATION_SIZE) -> (M, 15)."""
        weights, limit, (seen, acted) = self.weights, features.ACTION_LIMIT, self._mirrors
        first, inputs = weights.layers[0][0], len(weights.mean)
        source, sign = features.first_inputs(seen, inputs)
        hidden = np.empty((2 * len(observed), inputs))
        network.enter(observed, weights.mean, weights.scale, source, sign, first.row_step, first.bound, hidden)
        for (product, bias), (following, _) in pairwise(weights.layers):
            hidden = product.of_steps(hidden)
            network.activate(hidden, bias, following.row_step, following.bound)
        product, bias = weights.layers[-1]
        action = np.empty((len(observed), features.ACTION_SIZE))
        network.leave(product.of_steps(hidden), bias, *acted, limit, action)
        return action
