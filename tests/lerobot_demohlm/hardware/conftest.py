"""A link to nobody, and a simulated robot in its gantry, in a process of its own."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from lerobot_demohlm.benchmarks.deployment import RobotProcess
from lerobot_demohlm.hardware.link import Link
from tests.helpers.domains import free_domain


@pytest.fixture
def link() -> Iterator[Link]:
    """Yield a link in a DDS domain of its own."""
    with Link("lo", free_domain()) as made:
        yield made


@pytest.fixture
def hanging(tmp_path: Path) -> Iterator[tuple[RobotProcess, int]]:
    """Yield a robot whose gantry never lets go, and its DDS domain."""
    domain = free_domain()
    robot = RobotProcess("LiftBox", domain, tmp_path, ["--gantry-s", "1e9", "--region", "R1"])
    try:
        robot.wait_for("hangs", 300.0)
        yield robot, domain
    finally:
        robot.kill()
