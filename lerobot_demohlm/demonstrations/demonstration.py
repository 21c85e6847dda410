"""One recorded demonstration <-> a one-episode LeRobot dataset.

Row t holds what was measured before command t and the contact forces while it was carried out. Poses are 7 numbers,
position [m] and quaternion wxyz, in the world. Beside the data lie ``meta/demonstration.json`` (task, versions,
hashes), ``meta/snapshots.npz`` (the simulation's whole state before the first and after the last command) and, if
somebody has corrected the segmentation by hand, ``meta/segments.json``.
"""

import contextlib
import functools
import hashlib
import io
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.errors import DemonstrationError
from gym_demohlm.registry import get_task
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from gym_demohlm.timing import FPS

FORMAT_VERSION = 1
CONTACT_FORCE_N = 0.5  # normal force from which a hand touches an object: the push that moves 100 g of wood
META_PATH = Path("meta/demonstration.json")
SNAPSHOTS_PATH = Path("meta/snapshots.npz")
CORRECTIONS_PATH = Path("meta/segments.json")
_PACKAGED = Path(__file__).parent / "packaged"
_POSE_NAMES = ("x", "y", "z", "qw", "qx", "qy", "qz")
ARRAYS = (
    "state", "environment_state", "action", "pelvis_pose", "hand_poses", "hand_targets", "object_poses",
    "contact_forces", "success",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Demonstration:
    """A successful recording of one task at 10 Hz, T ticks, k tracked objects, P hand-object pairs.

    Attributes:
        task: Name of the task.
        state: (T, 68) float32, ``observation.STATE_NAMES``; its first 29 numbers are the joint positions.
        environment_state: (T, 9k) float32, objects in the camera frame.
        action: (T, 23) float32, ``command.NAMES``.
        pelvis_pose: (T, 7) in the world.
        hand_poses: (T, 2, 7) measured poses of the left and right palm.
        hand_targets: (T, 2, 7) poses that the operator asked of them.
        object_poses: (T, k, 7).
        contact_forces: (T, P) mean normal force of ``task.contact_pairs`` over the tick [N].
        success: (T,) bool, whether the task's condition held after the tick.
        start: Snapshot of the simulation before the first command.
        end: Snapshot of the simulation after the last command.
        metadata: format_version, task, versions, controller_hash, model_hash, operator, ...
        corrections: Hand-made corrections of the segmentation; None where there are none.
    """

    task: str
    state: np.ndarray
    environment_state: np.ndarray
    action: np.ndarray
    pelvis_pose: np.ndarray
    hand_poses: np.ndarray
    hand_targets: np.ndarray
    object_poses: np.ndarray
    contact_forces: np.ndarray
    success: np.ndarray
    start: dict[str, np.ndarray]
    end: dict[str, np.ndarray]
    metadata: dict[str, Any]
    corrections: dict[str, Any] | None = field(default=None)

    def __post_init__(self) -> None:
        """Check that every array has one row a tick and finite numbers."""
        for name in ARRAYS:
            array = getattr(self, name)
            if len(array) != len(self.action) or len(array) == 0:
                raise DemonstrationError(
                    f"{name} with {len(array)} ticks", f"{len(self.action)}, at least 1", "record it again"
                )
            if not np.isfinite(array).all():
                raise DemonstrationError(f"NaN or infinity in {name}", "finite numbers", "record it again")

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self.action)

    @property
    def joint_positions(self) -> np.ndarray:
        """(T, 29) float32 of the body joints [rad]."""
        return self.state[:, : len(g1.BODY_JOINTS)]

    @functools.cached_property
    def T_world_pelvis(self) -> np.ndarray:  # noqa: N802
        """(T, 4, 4)."""
        return _matrices(self.pelvis_pose)

    @functools.cached_property
    def T_world_hands(self) -> np.ndarray:  # noqa: N802
        """(T, 2, 4, 4) as measured."""
        return _matrices(self.hand_poses)

    @functools.cached_property
    def T_world_targets(self) -> np.ndarray:  # noqa: N802
        """(T, 2, 4, 4) as commanded."""
        return _matrices(self.hand_targets)

    @functools.cached_property
    def T_world_objects(self) -> np.ndarray:  # noqa: N802
        """(T, k, 4, 4)."""
        return _matrices(self.object_poses)

    @functools.cached_property
    def recording_hash(self) -> str:
        """The content hash without the corrections, which may come later: what the files must still have when read."""
        return self.content_hash if self.corrections is None else replace(self, corrections=None).content_hash

    @functools.cached_property
    def content_hash(self) -> str:
        """SHA-256 of everything that generation depends on: task, arrays, snapshots, hashes, corrections."""
        digest = hashlib.sha256()
        facts = {key: self.metadata.get(key) for key in ("controller_hash", "model_hash")}
        digest.update(json.dumps([FORMAT_VERSION, self.task, facts, self.corrections], sort_keys=True).encode())
        arrays = {name: getattr(self, name) for name in ARRAYS}
        arrays |= {f"start/{name}": array for name, array in self.start.items()}
        arrays |= {f"end/{name}": array for name, array in self.end.items()}
        for name in sorted(arrays):
            array = np.ascontiguousarray(arrays[name])
            digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
            digest.update(array.tobytes())
        return digest.hexdigest()

    def save(self, root: Path, task: Task) -> None:
        """Write the demonstration; nothing is left behind where it fails.

        Args:
            root: Directory to write; must not exist.
            task: What it is of; names the objects and contact pairs of the columns.

        Raises:
            DemonstrationError: The root exists, or it is of another task.
        """
        root = Path(root)
        if task.name != self.task:
            raise DemonstrationError(f"the task {task.name}", f"{self.task}, which was recorded", "give that task")
        if root.exists():
            raise DemonstrationError(f"the root {root}, which exists", "a new path", "choose another --root")
        temporary = root.with_name(f".{root.name}.partial")
        shutil.rmtree(temporary, ignore_errors=True)
        try:
            self._write(temporary, task)
            temporary.rename(root)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)

    def _write(self, root: Path, task: Task) -> None:
        from lerobot.datasets import LeRobotDataset

        features = _features(task)
        with _quiet():
            dataset = LeRobotDataset.create(
                f"demohlm/{task.slug}_demonstration",
                FPS,
                features,
                root=root,
                robot_type="unitree_g1",
                use_videos=False,
            )
            columns = self._columns(task)
            for tick in range(len(self)):
                frame = {key: np.atleast_1d(columns[key][tick]) for key in features}
                dataset.add_frame(frame | {"task": task.description})
            dataset.save_episode()
            dataset.finalize()
        arrays = {f"start.{name}": array for name, array in self.start.items()}
        arrays |= {f"end.{name}": array for name, array in self.end.items()}
        np.savez_compressed(root / SNAPSHOTS_PATH, allow_pickle=False, **arrays)
        content = self.metadata | {"content_hash": self.recording_hash}
        (root / META_PATH).write_text(json.dumps(content, indent=2, sort_keys=True) + "\n")
        if self.corrections is not None:
            (root / CORRECTIONS_PATH).write_text(json.dumps(self.corrections, indent=2) + "\n")

    def _columns(self, task: Task) -> dict[str, np.ndarray]:
        columns = {
            "observation.state": self.state,
            "observation.environment_state": self.environment_state,
            "action": self.action,
            "pelvis.pose": self.pelvis_pose,
            "next.success": self.success,
        }
        for index, side in enumerate(g1.SIDES):
            columns[f"{side}_palm.pose"] = self.hand_poses[:, index]
            columns[f"{side}_palm.target"] = self.hand_targets[:, index]
        for index, entry in enumerate(task.objects):
            columns[f"{entry.name}.pose"] = self.object_poses[:, index]
        for index, (side, name) in enumerate(task.contact_pairs):
            columns[f"{side}_palm_{name}.force"] = self.contact_forces[:, index]
        return columns


def _features(task: Task) -> dict[str, dict[str, Any]]:
    """Return the LeRobot feature table of a task's demonstration; what a replay compares is in double precision."""
    table: dict[str, dict[str, Any]] = {}

    def add(key: str, dtype: str, names: list[str]) -> None:
        table[key] = {"dtype": dtype, "shape": (len(names),), "names": names}

    add("observation.state", "float32", list(observation.STATE_NAMES))
    add("observation.environment_state", "float32", list(observation.environment_names(task)))
    add("action", "float32", list(command.NAMES))
    add("pelvis.pose", "float64", [f"pelvis_{axis}" for axis in _POSE_NAMES])
    for side in g1.SIDES:
        add(f"{side}_palm.pose", "float64", [f"{side}_palm_{axis}" for axis in _POSE_NAMES])
        add(f"{side}_palm.target", "float64", [f"{side}_palm_{axis}" for axis in _POSE_NAMES])
    for entry in task.objects:
        add(f"{entry.name}.pose", "float64", [f"{entry.name}_{axis}" for axis in _POSE_NAMES])
    for side, name in task.contact_pairs:
        add(f"{side}_palm_{name}.force", "float64", [f"{side}_palm_{name}_force"])
    add("next.success", "bool", ["success"])
    return table


def pose_numbers(T: np.ndarray) -> np.ndarray:
    """Return poses (..., 4, 4) as (..., 7): position [m] and quaternion wxyz."""
    return np.concatenate(poses.split(T), axis=-1)


def _matrices(numbers: np.ndarray) -> np.ndarray:
    return poses.pose(numbers[..., :3], numbers[..., 3:])


def default_root(task: Task) -> Path:
    """Return where the package keeps the demonstration of a task."""
    return _PACKAGED / task.slug


def load(root: Path | None = None, task: Task | None = None) -> Demonstration:
    """Read a demonstration.

    Args:
        root: Where it is; the packaged one of the task by default.
        task: The task that it must be of, and whose objects and contact pairs are read; any registered one by default.

    Raises:
        DemonstrationError: It is missing, damaged, of another task or version, or touches nothing.
    """
    if root is None:
        if task is None:
            raise DemonstrationError("neither a root nor a task", "one of the two", "name the task")
        root = default_root(task)
    root = Path(root)
    try:
        metadata = json.loads((root / META_PATH).read_text())
    except FileNotFoundError:
        raise DemonstrationError(
            f"{root} without {META_PATH}", "a demonstration", "name its directory, or record one with `demohlm record`"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise DemonstrationError(f"{root / META_PATH}, damaged ({error})", "a JSON object", "record it again") from None
    version = metadata.get("format_version") if isinstance(metadata, dict) else None
    if version != FORMAT_VERSION:
        raise DemonstrationError(
            f"{root} of format version {version}", f"format version {FORMAT_VERSION}", "record it with this version"
        )
    if task is not None and metadata.get("task") != task.name:
        raise DemonstrationError(
            f"a demonstration of {metadata.get('task')}", f"one of {task.name}", "choose another one, or another --task"
        )
    if ":" in str(metadata.get("task")):  # a file names no module to be imported
        raise DemonstrationError(f"a demonstration of {metadata['task']!r}", "the name of a task", "restore the files")
    demonstration = _read(root, task or get_task(str(metadata.get("task"))), metadata)
    if demonstration.recording_hash != metadata.get("content_hash"):
        raise DemonstrationError(
            f"{root} with content hash {demonstration.recording_hash[:12]}",
            f"{str(metadata.get('content_hash'))[:12]}, as when it was recorded",
            "restore the files, or record it again",
        )
    require_contact(demonstration)
    return demonstration


def require_contact(demonstration: Demonstration) -> None:
    """Raise ``DemonstrationError`` where no hand touches anything: then there is nothing to segment."""
    strongest = float(demonstration.contact_forces.max(initial=0.0))
    if strongest < CONTACT_FORCE_N:
        raise DemonstrationError(
            f"a demonstration of {demonstration.task} without contact (strongest force {strongest:.2f} N)",
            f"a hand that touches an object with {CONTACT_FORCE_N} N or more",
            "record it again",
        )


def _read(root: Path, task: Task, metadata: dict[str, Any]) -> Demonstration:
    """Read the files; whatever is wrong with them is one error, as readers of Parquet and zip files raise anything."""
    try:
        return _parse(root, task, metadata)
    except DemonstrationError:
        raise
    except Exception as error:
        raise DemonstrationError(f"{root}, damaged ({error})", "a demonstration", "record it again") from error


def _read_corrections(path: Path) -> Any:  # noqa: ANN401  what it says is checked where segments are cut
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise DemonstrationError(f"{path}, no JSON ({error})", "segments", "mend that file, or remove it") from error


def _parse(root: Path, task: Task, metadata: dict[str, Any]) -> Demonstration:
    import pyarrow.parquet as pq

    columns: dict[str, np.ndarray] = {}
    table = pq.read_table(root / "data")
    for key, feature in _features(task).items():
        column = table.column(key).combine_chunks()
        flat = column.flatten() if hasattr(column, "flatten") and column.type.num_fields else column
        values = flat.to_numpy(zero_copy_only=False).reshape(len(table), *feature["shape"])
        if values.dtype != feature["dtype"]:
            raise DemonstrationError(f"{key} of type {values.dtype}", feature["dtype"], "record it again")
        columns[key] = values
    with np.load(root / SNAPSHOTS_PATH, allow_pickle=False) as arrays:
        snapshots = {name: arrays[name] for name in arrays.files}
    corrections_path = root / CORRECTIONS_PATH
    corrections = _read_corrections(corrections_path) if corrections_path.exists() else None

    def stacked(pattern: str, names: tuple[str, ...]) -> np.ndarray:
        return np.stack([columns[pattern.format(name)] for name in names], axis=1)

    def snapshot(prefix: str) -> dict[str, np.ndarray]:
        return {name.removeprefix(prefix): array for name, array in snapshots.items() if name.startswith(prefix)}

    forces = [columns[f"{side}_palm_{name}.force"][:, 0] for side, name in task.contact_pairs]
    return Demonstration(
        task=task.name,
        state=columns["observation.state"],
        environment_state=columns["observation.environment_state"],
        action=columns["action"],
        pelvis_pose=columns["pelvis.pose"],
        hand_poses=stacked("{}_palm.pose", g1.SIDES),
        hand_targets=stacked("{}_palm.target", g1.SIDES),
        object_poses=stacked("{}.pose", tuple(entry.name for entry in task.objects)),
        contact_forces=np.stack(forces, axis=1) if forces else np.zeros((len(table), 0)),
        success=columns["next.success"][:, 0],
        start=snapshot("start."),
        end=snapshot("end."),
        metadata={key: value for key, value in metadata.items() if key != "content_hash"},
        corrections=corrections,
    )


def measure(sim: Simulation) -> dict[str, np.ndarray]:
    """Return the row of a demonstration that can be measured before a command, from a simulation of one world."""
    hands = np.stack([sim.pose(f"{side}_palm")[0] for side in g1.SIDES])
    objects = np.stack([sim.pose(entry.name)[0] for entry in sim.task.objects])
    return {
        "state": observation.agent_pos(sim)[0],
        "environment_state": observation.environment_state(sim)[0],
        "pelvis_pose": pose_numbers(sim.pose("pelvis")[0]),
        "hand_poses": pose_numbers(hands),
        "object_poses": pose_numbers(objects),
    }


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Hold back the progress bars of the dataset writer."""
    import datasets

    shown = datasets.are_progress_bars_disabled()
    datasets.disable_progress_bars()
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            yield
    finally:
        if not shown:
            datasets.enable_progress_bars()
