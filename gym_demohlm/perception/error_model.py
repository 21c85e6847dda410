"""How a tracker errs, as numbers: a bias of each episode, noise from frame to frame, tails, and when it is lost.

An error is a vector of three numbers (a shift, or a turn) in a frame whose x axis points at the object. It is
``s (c + A h(|g|) g / |g|)`` with

- ``g = sqrt(w) b + sqrt(1 - w) a``: ``b`` drawn once an episode, ``a`` a first-order autoregression; three numbers of
  a standard normal distribution each, so ``w`` is the bias's share;
- ``h``: the length that a length of ``g`` stands for, a table that follows the fitted errors' quantiles to their
  tails;
- ``c``: what is common to all episodes;
- ``A``: how much larger errors are in some directions;
- ``s = (distance / 0.7 m)**p exp(q (1 - visible share))``.

Whether a frame shows the object is a Markov chain whose odds depend on whether it is hidden.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.errors import SceneError
from gym_demohlm.files import replace_text
from gym_demohlm.task import Task

DISTANCE = 0.7  # m, at which ``s`` is 1
HIDDEN = 0.2  # visible share below which an object counts as hidden
PACKAGED = Path(__file__).parent / "fitted"


@dataclass(frozen=True, kw_only=True)
class Channel:
    """Errors of one kind: shifts [m] or turns [rad].

    Attributes:
        distance_power: p.
        hidden_rate: q.
        offset: c.
        axes: A, three rows of three.
        normal_lengths: Lengths of ``g`` in the table h, rising.
        error_lengths: Lengths that they stand for.
        bias_share: w.
        correlation: Of ``a`` from a frame to the next one, 0.1 s later.
    """

    distance_power: float
    hidden_rate: float
    offset: list[float]
    axes: list[list[float]]
    normal_lengths: list[float]
    error_lengths: list[float]
    bias_share: float
    correlation: float

    def errors(self, g: np.ndarray, distance: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Return errors (n, 3).

        Args:
            g: (n, 3) standard normal numbers.
            distance: (n,) from the camera [m].
            visible: (n,) shares.
        """
        length = np.linalg.norm(g, axis=-1)
        ratio = np.interp(length, self.normal_lengths, self.error_lengths) / np.maximum(length, 1e-12)
        spread = (np.array(self.axes) * g[:, None, :]).sum(axis=-1)  # each row by itself, in its bits
        return self.scale(distance, visible)[:, None] * (np.array(self.offset) + ratio[:, None] * spread)

    def scale(self, distance: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Return s (n,)."""
        return (np.maximum(distance, 0.1) / DISTANCE) ** self.distance_power * np.exp(
            self.hidden_rate * (1.0 - visible)
        )


@dataclass(frozen=True, kw_only=True)
class ObjectErrors:
    """How the pose of one object errs.

    Attributes:
        name: Of the object.
        shift: Errors of its place.
        turn: Errors of its orientation; of a round object's axis alone.
        lost_when_seen: Odds of a frame that does not show the object after one that did, where it is not hidden.
        lost_when_hidden: The same where it is hidden.
        found_when_seen: Odds of a frame that shows it after one that did not.
        found_when_hidden: The same where it is hidden.
        found_first: Odds of a frame that shows it, where none has yet and it is not hidden; None for those of
            ``found_when_seen``. Later another object may hide it, which is left out of what is visible.
    """

    name: str
    shift: Channel
    turn: Channel
    lost_when_seen: float
    lost_when_hidden: float
    found_when_seen: float
    found_when_hidden: float
    found_first: float | None = None


@dataclass(frozen=True, kw_only=True)
class ErrorModel:
    """How the poses of a task's objects err.

    Attributes:
        task: Name of the task.
        origin: What it was fitted to, in words: perception, region, seed, attempts, frames.
        objects: One an object of the task, in their order.
    """

    task: str
    origin: dict[str, Any]
    objects: tuple[ObjectErrors, ...]

    @property
    def hash(self) -> str:
        """SHA-256 of all numbers and of what they were fitted to."""
        return hashlib.sha256(json.dumps(self._content(), sort_keys=True).encode()).hexdigest()

    def write(self, path: Path) -> None:
        """Write the model with its hash."""
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_text(path, json.dumps({**self._content(), "hash": self.hash}, indent=1) + "\n")

    def _content(self) -> dict[str, Any]:
        """Return all numbers, without those that are not there."""
        content = asdict(self)
        objects = [{key: value for key, value in entry.items() if value is not None} for entry in content["objects"]]
        return {**content, "objects": objects}


def fitted_path(task: Task) -> Path:
    """Return where the packaged model of a task is."""
    return PACKAGED / f"{task.slug}.json"


def read_model(path: Path, task: Task) -> ErrorModel:
    """Return a fitted model.

    Raises:
        SceneError: There is none, it is damaged, or it is of another task.
    """
    remedy = f"fit one: demohlm fit-perception --task {task.name}"
    try:
        content = json.loads(path.read_text())
        expected = content.pop("hash")
        entries = [
            ObjectErrors(**{**entry, "shift": Channel(**entry["shift"]), "turn": Channel(**entry["turn"])})
            for entry in content.pop("objects")
        ]
        model = ErrorModel(objects=tuple(entries), **content)
    except FileNotFoundError:
        raise SceneError(f"no fitted errors at {path}", "a file of `demohlm fit-perception`", remedy) from None
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise SceneError(f"{path}, damaged ({error})", "a file of `demohlm fit-perception`", remedy) from error
    names = [entry.name for entry in task.objects]
    if model.task != task.name or [entry.name for entry in model.objects] != names:
        raise SceneError(f"{path} with errors of {model.task}", f"of {task.name}: {', '.join(names)}", remedy)
    if model.hash != expected:
        raise SceneError(f"{path} with the hash {model.hash[:12]}", f"{str(expected)[:12]}", remedy)
    return model
