"""Tasks -> how near a seeing perceiver comes to the truth in generated episodes, and what a frame costs.

Each episode is generated with exact poses and kept as snapshots; the perceiver looks at every one of them. So the
robot does what it would do if it saw perfectly, and the figures are those of the eyes alone.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception import camera, fit
from gym_demohlm.perception.estimate import PoseEstimate
from gym_demohlm.perception.meshes import ObjectMesh, object_meshes
from gym_demohlm.perception.rgbd import RgbdPerceiver, RgbdSettings
from gym_demohlm.perception.visual_model import VisualModel
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import ObjectSpec, Task
from gym_demohlm.timing import STEP_DT
from lerobot_demohlm.checks import portability
from lerobot_demohlm.reports.films import Snapshot, generated_take

SEEN = 0.2  # an object of which less is visible may be lost
_FOUND_AGAIN_S = 0.5
_GREEN, _RED = (60, 220, 60), (240, 60, 60)  # the true pose, the estimated one


@dataclass(frozen=True, kw_only=True)
class Look:
    """One frame of one world.

    Attributes:
        snapshot: The world's state.
        estimate: What the perceiver said.
        T_world_camera: (4, 4) the true pose of the camera.
        T_world_object: (k, 4, 4) the true poses of the objects.
        visible: (k,) share of each object's silhouette that is in the picture and not hidden.
        cpu_s: CPU time of the frame [s].
    """

    snapshot: Snapshot
    estimate: PoseEstimate
    T_world_camera: np.ndarray
    T_world_object: np.ndarray
    visible: np.ndarray
    cpu_s: float


def looks(task: Task, region: str, seed: int, index: int, settings: RgbdSettings | None = None) -> Iterator[Look]:
    """Yield what a perceiver sees in one generated episode.

    Args:
        task: The task.
        region: Initial region.
        seed: Of the run, and of the eyes.
        index: Of the attempt.
        settings: What is wrong with the eyes.
    """
    take = generated_take(task, region, seed, index)
    task = take.task
    sim = Simulation(task, 1)
    perceiver = RgbdPerceiver(task, 1, settings)
    row = np.array([0])
    perceiver.begin(row, [seed * 1000 + index])
    visual, meshes = VisualModel(sim.model), object_meshes(sim.model, task)
    try:
        for snapshot in take.snapshots:
            sim.restore(snapshot)
            began = time.process_time()
            estimate = perceiver.observe(sim, row)
            spent = time.process_time() - began
            T_world_object = np.stack([sim.pose(entry.name)[0] for entry in task.objects])
            T_world_camera = sim.pose("head_camera")[0]
            yield Look(
                snapshot=snapshot,
                estimate=estimate,
                T_world_camera=T_world_camera,
                T_world_object=T_world_object,
                visible=_visible(visual, sim, meshes, T_world_camera, T_world_object),
                cpu_s=spent,
            )
    finally:
        visual.close()
        perceiver.close()
        sim.close()


def measure(task: Task, region: str, seed: int, indices: Sequence[int]) -> list[dict[str, Any]]:
    """Return a line for each tracked object of a task.

    Args:
        task: The task.
        region: Initial region.
        seed: Of the run.
        indices: Of its attempts.
    """
    task = task.at(region)
    rows: list[list[tuple[float, float, float, bool]]] = [[] for _ in task.objects]
    again: list[list[float]] = [[] for _ in task.objects]
    cpu = []
    for index in indices:
        lost_since = [0.0] * len(task.objects)
        for look in looks(task, region, seed, index):
            cpu.append(look.cpu_s)
            for k, entry in enumerate(task.objects):
                told = look.T_world_camera @ look.estimate.T_camera_object[0, k]
                valid = bool(look.estimate.valid[0, k])
                rows[k].append((*pose_error(told, look.T_world_object[k], entry), float(look.visible[k]), valid))
                seen = look.visible[k] >= SEEN
                if valid and lost_since[k] > 0:
                    again[k].append(lost_since[k])
                lost_since[k] = lost_since[k] + STEP_DT if seen and not valid else 0.0
    lines = []
    for k, entry in enumerate(task.objects):
        seen = np.array([row for row in rows[k] if row[2] >= SEEN])
        found = seen[seen[:, 3] > 0]
        lines.append(
            {
                "task": task.name,
                "stamp": portability.stamp(task),
                "object": entry.name,
                "region": region,
                "seed": seed,
                "attempts": len(indices),
                "frames": len(rows[k]),
                "frames_seen": len(seen),
                "position_mm": _quantiles(found[:, 0]),
                "turn_deg": _quantiles(found[:, 1]),
                "lost_share": round(float(1.0 - len(found) / max(1, len(seen))), 4),
                "found_again_late": sum(1 for wait in again[k] if wait > _FOUND_AGAIN_S),
                "frame_cpu_ms": _quantiles(1e3 * np.array(cpu)),
                "objects": len(task.objects),
            }
        )
    return lines


def pose_error(told: np.ndarray, truth: np.ndarray, entry: ObjectSpec) -> tuple[float, float]:
    """Return the distance [mm] and angle [degrees] between poses (4, 4), the least of those that look the same.

    For a round object the angle is that between the axes.
    """
    distance = 1e3 * float(np.linalg.norm(told[:3, 3] - truth[:3, 3]))
    if entry.symmetry == "any":
        return distance, float(np.degrees(np.arccos(np.clip(told[:3, 2] @ truth[:3, 2], -1.0, 1.0))))
    same = [truth @ poses.planar(0.0, 0.0, turn) for turn in entry.symmetry]
    turns = [np.linalg.norm(poses.rotation_vector(told[:3, :3].T @ other[:3, :3])) for other in same]
    return distance, float(np.degrees(min(turns)))


def drawn(task: Task, region: str, seed: int, index: int, every: int = 1) -> Iterator[np.ndarray]:
    """Yield pictures (480, 640, 3) uint8 of the head camera with true poses in green and estimated ones in red.

    Args:
        task: The task.
        region: Initial region.
        seed: Of the run.
        index: Of the attempt.
        every: Frames from one picture to the next.
    """
    task = task.at(region)
    sim = Simulation(task, 1)
    with closing(VisualModel(sim.model, cell=0.0)) as visual:
        shapes = [fit.Shape(mesh) for mesh in object_meshes(sim.model, task)]
        for count, look in enumerate(looks(task, region, seed, index)):
            if count % every:
                continue
            sim.restore(look.snapshot)
            _place(visual, sim)
            if task.memory is not None:
                task.memory.draw(visual.model, sim.memory[0])
            picture = np.ascontiguousarray(visual.rgb())
            T_optical_world = poses.invert(visual.camera_pose())
            for k, shape in enumerate(shapes):
                told = look.T_world_camera @ look.estimate.T_camera_object[0, k]
                for T, colour in ((look.T_world_object[k], _GREEN), (told, _RED)):
                    _wire(picture, shape, T_optical_world @ T, visual.intrinsics, colour)
                text = f"{task.objects[k].name}: {look.visible[k]:.0%} visible"
                if not look.estimate.valid[0, k]:
                    text += f", not seen for {look.estimate.age_s[0, k]:.1f} s"
                error = pose_error(told, look.T_world_object[k], task.objects[k])
                text += f", {error[0]:.1f} mm, {error[1]:.1f} deg"
                cv2.putText(
                    picture, text, (8, 18 + 16 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (20, 20, 20), 1, cv2.LINE_AA
                )
            yield picture
    sim.close()


def _wire(
    picture: np.ndarray, shape: fit.Shape, T: np.ndarray, intrinsics: camera.Intrinsics, colour: tuple[int, int, int]
) -> None:
    """Draw the edges of a mesh at ``T_optical_object``."""
    p_optical = poses.transform(T, shape.vertices)
    if p_optical[:, 2].min() < 0.05:
        return
    uv = np.clip(intrinsics.project(p_optical), -4000, 4000).round().astype(int)
    for first, last in shape.edges:
        cv2.line(picture, uv[first].tolist(), uv[last].tolist(), colour, 1, cv2.LINE_AA)


def _place(visual: VisualModel, sim: Simulation) -> None:
    model = sim.model
    bodies = np.argsort(model.body_mocapid, kind="stable")[model.nbody - model.nmocap :]
    placed = [poses.split(sim.pose(model.body(body).name)[0]) for body in bodies]
    positions = np.array([position for position, _ in placed]).reshape(-1, 3)
    visual.place(sim.qpos[0], positions, np.array([quat for _, quat in placed]).reshape(-1, 4))


def _visible(
    visual: VisualModel,
    sim: Simulation,
    meshes: Sequence[ObjectMesh],
    T_world_camera: np.ndarray,
    T_world_object: np.ndarray,
) -> np.ndarray:
    """Return the visible share (k,) of each object: its pixels over those of its whole silhouette, cut off or not."""
    _place(visual, sim)
    ids = visual.depth_and_ids().ids
    known, margin = visual.intrinsics, 480
    wide = camera.Window(left=-margin, top=-margin, width=known.width + 2 * margin, height=known.height + 2 * margin)
    shares = []
    for mesh, T in zip(meshes, T_world_object, strict=True):
        T_optical_object = camera.T_OPTICAL_CAMERA @ poses.invert(T_world_camera) @ T
        whole = int(fit.silhouette(fit.Shape(mesh), T_optical_object, known, wide).sum())
        shares.append(min(1.0, np.count_nonzero(np.isin(ids, mesh.geoms)) / max(1, whole)))
    return np.array(shares)


def _quantiles(values: np.ndarray) -> dict[str, float] | None:
    """Return the median and the 95th percentile; None of nothing."""
    if len(values) == 0:
        return None
    return {"median": round(float(np.median(values)), 2), "p95": round(float(np.percentile(values, 95)), 2)}
