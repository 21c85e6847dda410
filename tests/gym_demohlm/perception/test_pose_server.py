"""The answers of the reference server and of the one in the documentation: poses that are right, or a reason."""

import re
import sys
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gym_demohlm.perception import masks
from gym_demohlm.perception.error_fit import pose_errors
from gym_demohlm.perception.meshes import known_meshes
from gym_demohlm.perception.pose_server import Backend, TrackerBackend
from gym_demohlm.perception.visual_model import VisualModel
from gym_demohlm.perception.wire import Answer, Request
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from tests.helpers.documented import REPOSITORY, blocks
from tests.helpers.hold import HoldController


def _asked(task: Task, region: str, seed: int, *, with_masks: bool) -> tuple[list[Answer], np.ndarray]:
    """Return what the server says of one picture without noise, and the true poses (k, 4, 4) in its frame."""
    names = tuple(entry.name for entry in task.objects)
    sim = Simulation(task, 1, controller=HoldController(1))
    with closing(sim), closing(VisualModel(sim.model, cell=0.0)) as visual:
        sim.reset([task.sample(region, np.random.default_rng(seed))])
        bodies = np.argsort(sim.model.body_mocapid, kind="stable")[sim.model.nbody - sim.model.nmocap :]
        mocap = sim.snapshot()["mocap"][0].reshape(-1)
        count = 3 * len(bodies)
        visual.place(sim.qpos[0], mocap[:count].reshape(-1, 3), mocap[count:].reshape(-1, 4))
        frame, meshes = visual.depth_and_ids(), known_meshes(sim.scene)
        seen = tuple(np.isin(frame.ids, mesh.geoms) for mesh in meshes)
        T_optical_world = np.linalg.inv(visual.camera_pose())
        request = Request(
            session="a", frame=0, task=task.name, objects=names, K=visual.intrinsics.matrix,
            T_odom_optical=visual.camera_pose(), hands={}, color=np.ascontiguousarray(visual.rgb()),
            depth=np.ascontiguousarray(frame.depth), masks=seen if with_masks else None,
        )  # fmt: skip
        return TrackerBackend()(request), np.stack([T_optical_world @ sim.pose(name)[0] for name in names])


@pytest.mark.parametrize("seed", [970000, 970001, 970002])
def test_what_has_a_front_is_not_turned(seed: int) -> None:
    """A cabinet's back looks like its front; that the robot stands before it, and its door, tell which it is."""
    task = get_task("OpenCabinet")
    answers, truth = _asked(task, "R3", seed, with_masks=True)
    assert all(answer.valid for answer in answers)
    for answer, T, entry in zip(answers, truth, task.objects, strict=True):
        shift, turn = pose_errors(answer.T_optical_object[None], T[None], entry)
        assert np.linalg.norm(shift) < 0.02 and np.linalg.norm(turn) < np.radians(5.0), entry.name


@pytest.mark.parametrize("name", sorted(all_tasks()))
def test_without_masks_a_task_of_grey_things_gets_reasons_and_no_poses(name: str) -> None:
    """As ``masks=color`` refuses it: walls are as grey as they."""
    backend, task = TrackerBackend(), get_task(name)
    names = tuple(entry.name for entry in task.objects)
    request = Request(
        session="a", frame=0, task=name, objects=names, K=np.eye(3), T_odom_optical=np.eye(4), hands={},
        color=np.zeros((48, 64, 3), np.uint8), depth=np.ones((48, 64), np.float32), masks=None,
    )  # fmt: skip
    grey = masks.grey(backend._form(request).meshes.values())
    answers = backend(request)
    assert len(answers) == len(names) and not any(answer.valid for answer in answers)
    assert all(("from walls: send masks" in answer.reason) == bool(grey) for answer in answers)
    assert all(one in answer.reason and len(answer.reason) <= 80 for one in grey for answer in answers)


def test_walls_are_no_cart() -> None:
    answers, _ = _asked(get_task("PushCart"), "R1", 970000, with_masks=False)
    assert not any(answer.valid for answer in answers)


class Estimator:
    """A stand-in for FoundationPose: it has the object 1 m before the lens, and notes how it was asked."""

    asked: list[str]
    T: np.ndarray

    def __init__(self, *_: object, **__: object) -> None:
        Estimator.asked.append("made")

    def register(self, *_: object, **__: object) -> np.ndarray:
        Estimator.asked.append("register")
        return Estimator.T

    def track_one(self, *_: object, **__: object) -> np.ndarray:
        Estimator.asked.append("track")
        return Estimator.T


@pytest.fixture
def documented(monkeypatch: pytest.MonkeyPatch) -> Backend:
    """Return the backend of docs/perception.md, as printed, with stand-ins for what is NVIDIA's."""
    Estimator.asked, Estimator.T = [], np.eye(4)
    Estimator.T[2, 3] = 1.0
    monkeypatch.setitem(sys.modules, "estimater", SimpleNamespace(FoundationPose=Estimator))
    served: list[Backend] = []
    monkeypatch.setattr("gym_demohlm.perception.pose_server.serve", lambda backend, address: served.append(backend))
    (text,) = (
        block for block in blocks((REPOSITORY / "docs/perception.md").read_text(), "text") if "estimater" in block
    )
    assert re.search(r"^serve\(", text, re.MULTILINE)
    mesh = SimpleNamespace(vertices=0.06 * np.eye(3), vertex_normals=np.eye(3))
    exec(text, {"meshes": {"red": mesh, "blue": mesh}})
    return served[0]


def _stacking(**changes: Any) -> Request:
    full, empty = np.ones((48, 64), bool), np.zeros((48, 64), bool)
    K = np.array([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]])
    plain = Request(
        session="a", frame=0, task="StackCube", objects=("red", "blue"), K=K, T_odom_optical=np.eye(4), hands={},
        color=np.zeros((48, 64, 3), np.uint8), depth=np.ones((48, 64), np.float32), masks=(full, empty),
    )  # fmt: skip
    return replace(plain, **changes)


def test_the_documented_backend_registers_then_tracks_and_says_what_it_does_not_see(documented: Backend) -> None:
    for _ in range(2):
        red, blue = documented(_stacking())
        np.testing.assert_array_equal(red.T_optical_object, Estimator.T)
        assert red.valid and not blue.valid and blue.reason == "an object that is not seen"
    assert Estimator.asked == ["made", "register", "track"]
    for changes in ({"masks": None}, {"depth": np.zeros((48, 64), np.float32)}):
        assert all(not one.valid and "needs masks and depth" in one.reason for one in documented(_stacking(**changes)))


def test_the_documented_backend_believes_no_pose_beside_the_mask_and_registers_anew(documented: Backend) -> None:
    documented(_stacking())
    corner = np.zeros((48, 64), bool)
    corner[:12, :12] = True
    red, _ = documented(_stacking(masks=(corner, ~corner & False)))
    assert not red.valid and "not where the mask is" in red.reason
    assert documented(_stacking())[0].valid
    assert Estimator.asked == ["made", "register", "track", "made", "register"]


def test_the_documented_backend_keeps_few_sessions(documented: Any) -> None:
    for number in range(20):
        documented(_stacking(session=str(number)))
    assert list(documented.sessions) == ["16", "17", "18", "19"]
