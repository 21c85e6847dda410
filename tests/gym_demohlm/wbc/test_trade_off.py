"""The command range is drawn together about the robot at rest, and what that brings is measured and drawn."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gym_demohlm.robot import g1
from gym_demohlm.wbc.evaluation.trade_off import draw_trade_off, trade_off
from gym_demohlm.wbc.evaluation.trial_commands import CommandRange


def test_range_shrinks_about_rest() -> None:
    whole, half, none = CommandRange(), CommandRange().scaled(0.5), CommandRange().scaled(0.0)
    assert CommandRange().scaled(1.0) == whole
    assert half.forward == pytest.approx((-0.25, 0.4))
    assert half.height == pytest.approx(((0.40 + g1.PELVIS_HEIGHT) / 2, (0.76 + g1.PELVIS_HEIGHT) / 2))
    assert none.height == pytest.approx((g1.PELVIS_HEIGHT, g1.PELVIS_HEIGHT))
    assert none.pitch == none.roll == none.yaw == none.yaw_rate == (0.0, 0.0)
    assert none.arm_speed == whole.arm_speed


def test_points_for_every_load_and_share(tmp_path: Path) -> None:
    found = trade_off(2, 4.4, 0, 1, shares=(0.2, 0.4), hand_loads=(0.0, 1.0))
    assert [(point["hand_load"], point["share"]) for point in found["points"]] == [
        (0.0, 0.2),
        (0.0, 0.4),
        (1.0, 0.2),
        (1.0, 0.4),
    ]
    assert all(np.isfinite(list(point.values())).all() and 0 <= point["survival"] <= 1 for point in found["points"])
    draw_trade_off(found, tmp_path / "trade_off.png")
    assert np.asarray(Image.open(tmp_path / "trade_off.png").convert("RGB")).std() > 10
