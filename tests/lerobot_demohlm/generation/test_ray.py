"""Blocks made on a Ray cluster are those that processes make, also where a node is killed on the way."""

import contextlib
import dataclasses
import importlib
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from gym_demohlm import registry
from gym_demohlm.errors import DatasetError
from lerobot_demohlm.generation.request import GenerationRequest
from lerobot_demohlm.generation.run import partial_directory
from lerobot_demohlm.generation.runner import generate
from tests.helpers import makes
from tests.helpers.paths import REPOSITORY

ray_workers = pytest.importorskip("lerobot_demohlm.generation.ray_workers", reason="needs the extra [ray]")
ray = ray_workers.ray
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
_TRIES = 4


@pytest.fixture(scope="module")
def faults() -> Iterator[ModuleType]:
    """Return the module; its task is known to these tests alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "_registered", registry.all_tasks())
        for name in ("faults", "brief_task"):
            patch.delitem(sys.modules, f"lerobot_demohlm.benchmarks.{name}", raising=False)
        patch.setenv("PYTHONPATH", str(REPOSITORY))  # for workers on other nodes
        yield importlib.import_module("lerobot_demohlm.benchmarks.faults")


def _started_cluster() -> Any:
    """Start two nodes; Ray gives each 30 s to start, which a busy machine may exceed, so it is tried again."""
    from ray.cluster_utils import Cluster

    for attempt in range(_TRIES):
        cluster = Cluster()
        try:
            for _ in range(2):
                cluster.add_node(num_cpus=1, include_dashboard=False)
            cluster.wait_for_nodes()
        except Exception:
            cluster.shutdown()
            if attempt == _TRIES - 1:
                raise
        else:
            return cluster
    raise AssertionError


@pytest.fixture
def cluster(faults: ModuleType) -> Iterator[Any]:
    """Return a cluster of two nodes with one CPU each, this process connected to it."""
    cluster = _started_cluster()
    try:
        ray.init(address=cluster.address, logging_level="error", log_to_driver=False)
        yield cluster
    finally:
        ray.shutdown()
        cluster.shutdown()


def request(root: Path, demonstration: Path, **changes: object) -> GenerationRequest:
    base = GenerationRequest(
        task="lerobot_demohlm.benchmarks.brief_task:LiftBoxBriefly",
        region="R1",
        seed=0,
        root=root,
        num_attempts=48,
        block_size=4,
        demonstration=demonstration,
        show_progress=False,
    )
    return dataclasses.replace(base, **changes)


def test_a_cluster_that_loses_a_node_makes_the_same_dataset(tmp_path: Path, faults: ModuleType, cluster: Any) -> None:
    demonstration = tmp_path / "demonstration"
    sys.modules["lerobot_demohlm.benchmarks.brief_task"].save_demonstration(demonstration)
    alone = generate(request(tmp_path / "alone", demonstration))
    other = next(node for node in cluster.list_all_nodes() if node is not cluster.head_node)
    killed: list[int] = []

    def kill_a_node() -> None:
        blocks = partial_directory(tmp_path / "ray") / "blocks"
        while not (found := list(blocks.glob("[0-9]*"))):
            time.sleep(0.05)
        cluster.remove_node(other, allow_graceful=False)
        killed.append(len(found))

    killer = threading.Thread(target=kill_a_node, daemon=True)
    killer.start()
    together = generate(request(tmp_path / "ray", demonstration, backend="ray", num_workers=2))
    killer.join()
    assert 1 <= killed[0] < 12  # on the way
    assert faults.digest(tmp_path / "ray") == faults.digest(tmp_path / "alone")
    assert together.outcomes == alone.outcomes


def test_errors_arrive_and_nothing_is_left_running(tmp_path: Path, cluster: Any) -> None:
    (tmp_path / "blocks").mkdir()
    with contextlib.closing(ray_workers.RayWorkers(makes.fail, tmp_path, 2)) as workers:
        workers.submit(range(8, 12))
        with pytest.raises(DatasetError, match="got attempts 8; expected others"):
            workers.wait()
    with contextlib.closing(ray_workers.RayWorkers(makes.stumble, tmp_path, 2)) as workers:
        workers.submit(range(8, 12))
        with pytest.raises(ray.exceptions.RayTaskError, match="ZeroDivisionError"):
            workers.wait()
    with contextlib.closing(ray_workers.RayWorkers(makes.die_once, tmp_path, 1)) as workers:
        workers.submit(range(4))
        died = workers.wait()[0]
        assert died.death
    assert ray.is_initialized()  # the cluster was there before
    assert list((tmp_path / "blocks").iterdir()) == []
