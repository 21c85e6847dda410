"""What every test runs under: software rendering, one BLAS thread, no network."""

import os

os.environ.setdefault("MUJOCO_GL", "egl")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the root of a dataset of few attempts, of which some failed; not to be changed."""
    import small_run as module

    root = tmp_path_factory.mktemp("small") / "run"
    module.generate(root)
    return root
