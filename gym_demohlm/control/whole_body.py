"""Proprioception and commands -> joint targets at 50 Hz: the trained whole-body controller, batched, NumPy only.

A world's targets have the same bits whether it is computed alone or in a batch, and on every processor: the network's
products are exact (``arithmetic.ExactProduct``).
"""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.arithmetic import ExactProduct, elu
from gym_demohlm.control import attitude, command, features, odometry, reference, trim
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.errors import SceneError
from gym_demohlm.robot import g1
from gym_demohlm.timing import CONTROL_DT

DEFAULT_WEIGHTS = Path(__file__).parent / "weights" / "g1_whole_body.npz"
WEIGHTS_FORMAT = 4
_LARGEST_INPUT = 6.0  # deviations from the mean: what training clips observations to
_LARGEST_HIDDEN = 64.0  # of a hidden unit: far above what occurs
_HISTORY = features.HISTORY * features.FRAME_SIZE
_SLEWED = slice(_HISTORY + features.ACTION_SIZE, _HISTORY + features.ACTION_SIZE + 7)
_CLOCK = _SLEWED.stop
_VELOCITY = slice(_CLOCK + 3, _CLOCK + 5)
_ARM_TARGETS = slice(_VELOCITY.stop, _VELOCITY.stop + len(features.OBSERVED_ARM_JOINTS))
_CARRIED = slice(_ARM_TARGETS.stop, _ARM_TARGETS.stop + 2)
_TRIM = slice(_CARRIED.stop, _CARRIED.stop + 5)
# History, last action, slewed command, phase, stopped, standing, odometry, arms, loads, trim.
STATE_SIZE = _TRIM.stop
_TRIMMED, _TORSO = slice(2, 7), slice(3, 7)  # of a slewed command
_CONSTANT = 0.01  # m/s, m, rad: a command that moves on by less than this in a step is taken for a constant one
_WHILE_STANDING = np.array([False, True, True, True, True])  # when an entry is trimmed
_LEGS = len(g1.LEG_JOINTS)
_ARM_POSITIONS = reference.NUM_LOWER + features.OBSERVED_ARM_INDEX


class Weights:
    """The exported policy: layers, normaliser, quasi-static tables and metadata.

    Args:
        path: An ``.npz`` written by ``gym_demohlm.wbc.training.export``. Nothing in it is executed or unpickled.

    Attributes:
        metadata: How it was trained and what it expects.
        hash: SHA-256 of the file.

    Raises:
        SceneError: The file is missing, damaged, or of another format.
    """

    def __init__(self, path: Path = DEFAULT_WEIGHTS) -> None:
        try:
            content = path.read_bytes()
            with np.load(path, allow_pickle=False) as arrays:
                loaded = {name: arrays[name] for name in arrays.files}
            self.metadata: dict[str, Any] = json.loads(loaded["metadata"].tobytes())
            layers = int(self.metadata["layers"])
            self.layers = [
                (
                    ExactProduct(loaded[f"weight_{i}"], _LARGEST_HIDDEN if i else _LARGEST_INPUT),
                    loaded[f"bias_{i}"].astype(np.float64),
                )
                for i in range(layers)
            ]
            self.mean, self.scale = (loaded[name].astype(np.float64) for name in ("mean", "scale"))
            self._tables = loaded["posture_table"], loaded["arm_table"]
        except Exception as error:  # readers of zip files raise anything
            raise SceneError(
                f"controller weights {path.name} that cannot be read ({error})",
                "an .npz file exported by demohlm train-controller",
                "reinstall the package, or export the weights again",
            ) from error
        found = (self.metadata.get("format"), self.metadata.get("observation_size"))
        if found != (WEIGHTS_FORMAT, features.OBSERVATION_SIZE):
            raise SceneError(
                f"controller weights of format {found[0]} for {found[1]} observations",
                f"format {WEIGHTS_FORMAT} for {features.OBSERVATION_SIZE}",
                "train or install weights for this version",
            )
        self.hash = hashlib.sha256(content).hexdigest()

    def make_reference(self) -> reference.Reference:
        """Return the reference pose that the policy corrects."""
        return reference.Reference(*self._tables)


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
        self.state = np.zeros((num_worlds, STATE_SIZE))
        ranges = g1.joint_ranges(g1.read_mjcf())
        self._lower, self._upper = ranges[:, 0], ranges[:, 1]

    def reset(self, worlds: np.ndarray, sensed: Proprioception) -> None:
        """Start the controllers of some worlds anew, standing at rest.

        Args:
            worlds: (M,) indices.
            sensed: What the robots of these worlds sense, M rows.
        """
        quat_wxyz, gyro, q, dq = sensed.quat_wxyz, sensed.gyro, sensed.q, sensed.dq
        seen = features.OBSERVED_INDEX
        frame = features.frame(quat_wxyz, gyro, q[:, seen], dq[:, seen])
        state = np.zeros((len(worlds), STATE_SIZE))
        state[:, :_HISTORY] = np.tile(frame, (1, features.HISTORY))
        state[:, _SLEWED] = command.rest()[:7]
        state[:, _CLOCK : _CLOCK + 3] = [reference.REST_PHASES[0], 2.0, 1.0]
        state[:, _ARM_TARGETS] = q[:, _ARM_POSITIONS]
        self.state[worlds] = state

    def step(self, sensed: Proprioception, commands: np.ndarray, worlds: np.ndarray | None = None) -> np.ndarray:
        """Advance by one tick of 0.02 s.

        Args:
            sensed: What M robots sense; of the pelvis orientation only the direction of gravity is used.
            commands: (M, 23) within their bounds; velocity and torso are slewed here, arms pass through.
            worlds: (M,) which worlds these rows belong to; all by default.

        Returns:
            Joint targets (M, 29) [rad].
        """
        quat_wxyz, gyro, q, dq = sensed.quat_wxyz, sensed.gyro, sensed.q, sensed.dq
        chosen = slice(None) if worlds is None else worlds
        state = self.state[chosen]
        rows, seen = len(state), features.OBSERVED_INDEX
        frame = features.frame(quat_wxyz, gyro, q[:, seen], dq[:, seen])
        history = np.concatenate([state[:, features.FRAME_SIZE : _HISTORY], frame], axis=1)
        current, stands = state[:, _SLEWED], state[:, _CLOCK + 2] > 0.5
        goal = reference.admissible(commands, current, stands)
        slewed = reference.slew(current, goal)
        down = features.gravity(quat_wxyz)
        velocity, sole_tilt, height = odometry.estimate(down, gyro, q[:, :_LEGS], dq[:, :_LEGS])
        velocity = odometry.smooth(state[:, _VELOCITY], velocity)
        down_torso = attitude.in_torso(down, q[:, _LEGS : reference.NUM_LOWER])
        carried = self.reference.arm_load.weigh(
            state[:, _CARRIED],
            state[:, _ARM_TARGETS],
            q[:, _ARM_POSITIONS],
            dq[:, _ARM_POSITIONS],
            down_torso,
            CONTROL_DT,
        )
        phase, stopped, standing = reference.advance_clock(
            state[:, _CLOCK],
            state[:, _CLOCK + 1],
            stands,
            slewed[:, :3],
            reference.startled(velocity, sole_tilt),
        )
        turning = -(down * gyro).sum(axis=1)
        measured = np.stack([turning, height, *attitude.roll_pitch(down_torso), q[:, _LEGS]], axis=1)
        constant = (np.abs(goal - current) < _CONSTANT).all(axis=1, keepdims=True)
        learns = constant & (standing[:, None] == _WHILE_STANDING)
        correction = trim.advance(state[:, _TRIM], slewed[:, _TRIMMED], measured, learns)
        torso, torso_height = slewed[:, _TORSO], slewed[:, _TORSO.start]
        trimmed = reference.balanced(torso + correction[:, 1:], torso_height)
        correction[:, 1:] = trimmed - reference.balanced(torso, torso_height)
        told = slewed.copy()
        told[:, _TRIMMED] += correction
        arms = commands[:, command.ARMS]
        most_arms = arms[:, features.OBSERVED_ARM_INDEX]
        observed = features.observation(
            history.reshape(rows, features.HISTORY, features.FRAME_SIZE),
            state[:, _HISTORY : _HISTORY + features.ACTION_SIZE],
            most_arms,
            told,
            phase,
            standing,
            velocity,
        )
        action = np.clip(self._act(observed), -features.ACTION_LIMIT, features.ACTION_LIMIT)
        clock = np.stack([phase, stopped, standing.astype(np.float64)], axis=1)
        self.state[chosen] = np.concatenate(
            [history, action, slewed, clock, velocity, most_arms, carried, correction], axis=1
        )
        lower = self.reference(told, phase, standing, velocity, most_arms, carried)
        lower += action * reference.action_scale(standing, torso)
        return np.clip(np.concatenate([lower, arms], axis=1), self._lower, self._upper)

    def _act(self, observed: np.ndarray) -> np.ndarray:
        """Return the symmetric policy's mean action, (M, OBSERVATION_SIZE) -> (M, 15)."""
        latent = (observed - self.weights.mean) * self.weights.scale  # the first product clips it
        hidden = np.concatenate([latent, features.mirror(latent, features.OBSERVATION_MIRROR)])
        for product, bias in self.weights.layers[:-1]:
            hidden = elu(product(hidden) + bias)
        product, bias = self.weights.layers[-1]
        seen, in_mirror = np.split(product(hidden) + bias, 2)
        return 0.5 * (seen + features.mirror(in_mirror, features.ACTION_MIRROR))
