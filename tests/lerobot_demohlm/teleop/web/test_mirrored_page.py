"""A person at the page who drives a robot at the other end of a network: the page shows its mirror."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_demohlm.control import command
from lerobot_demohlm.devices import live
from lerobot_demohlm.devices.config_operators import DemoHLMWebConfig
from lerobot_demohlm.devices.mirror import Mirror
from lerobot_demohlm.devices.operators import DemoHLMWeb
from tests.helpers.robot import Told
from tests.helpers.teleop import opened, wait_for


def test_keys_at_the_page_move_the_robot_that_it_mirrors(
    browser: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = Told("LiftBox", dz=0.3)
    mirror = Mirror(told.sim.task, told.read)
    operator = DemoHLMWeb(DemoHLMWebConfig(id="test", calibration_dir=tmp_path, port=0))
    live.set_current(mirror)
    arms = list(command.NAMES[command.ARMS])
    try:
        operator.connect()
        rest = operator.get_action()
        printed: list[str] = []
        wait_for(lambda: printed.append(capsys.readouterr().out) or "serving" in "".join(printed))
        with opened(browser, json.loads("".join(printed))["operator"]) as page:
            shown = page.evaluate("demohlm.status.poses")
            for name, body in (("pelvis", "pelvis"), ("right_palm", "right_palm"), ("box", "box")):
                np.testing.assert_allclose(shown[name][:3], told.sim.pose(body)[0, :3, 3], atol=0.01)
            page.screenshot(path=tmp_path / "mirror.png")
            page.keyboard.down("ArrowUp")

            def moved() -> bool:
                action = operator.get_action()
                return max(abs(action[name] - rest[name]) for name in arms) > 0.1

            wait_for(moved)
            page.keyboard.up("ArrowUp")
            page.keyboard.down("KeyQ")
            wait_for(lambda: operator.get_action()["base_yaw.vel"] > 0.4)
            page.keyboard.up("KeyQ")
            wait_for(lambda: operator.get_action()["base_yaw.vel"] == 0.0)
    finally:
        live.set_current(None)
        operator.disconnect()
        mirror.close()
        told.sim.close()
