"""What every test runs under: software rendering, one BLAS thread, no network."""

import os

os.environ.setdefault("MUJOCO_GL", "egl")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

from collections.abc import Iterator
from pathlib import Path

import pytest

from gym_demohlm import registry

SLOW_S = 3600  # a slow test may take so long on a busy machine


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give slow tests more time, but for those that say how much they need."""
    for item in items:
        if item.get_closest_marker("slow") is not None and item.get_closest_marker("timeout") is None:
            item.add_marker(pytest.mark.timeout(SLOW_S))


@pytest.fixture(autouse=True)
def known_tasks() -> Iterator[None]:
    """Forget the tasks that a test has registered."""
    before = registry.all_tasks()
    yield
    registry._registered.clear()
    registry._registered.update(before)


@pytest.fixture(scope="session")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the root of a dataset of few attempts, of which some failed; not to be changed."""
    from tests.helpers import small_run as module

    root = tmp_path_factory.mktemp("small") / "run"
    module.generate(root)
    return root
