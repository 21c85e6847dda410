"""A browser for the tests of the page; they skip where there is none."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from lerobot_demohlm.benchmarks.teleoperation import FLAGS
from tests.helpers.teleop import fetch_iwer, find_browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Return a browser; while it runs, this thread has an event loop that no other test can share."""
    path = find_browser()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield started
        started.close()


@pytest.fixture(scope="session")
def iwer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fetch_iwer(tmp_path_factory.mktemp("iwer"))
