"""Rendering: lazily made, and the pictures show what they should."""

import mujoco
import numpy as np
import pytest

from gym_demohlm.control import command
from gym_demohlm.envs.env import DemoHLMEnv
from gym_demohlm.envs.rendering import HEIGHT, WIDTH, Renderer
from gym_demohlm.errors import SceneError
from tests.helpers.hold import HoldController


def test_state_observations_never_make_a_graphics_context(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a renderer was made")

    monkeypatch.setattr(mujoco, "Renderer", refuse)
    env = DemoHLMEnv(controller=HoldController(1), render_mode="rgb_array")
    env.reset(seed=0)
    env.step(command.rest().astype(np.float32))
    env.close()


def test_pictures_show_the_box_where_the_camera_looks() -> None:
    env = DemoHLMEnv(controller=HoldController(1), obs_type="pixels_agent_pos", render_mode="rgb_array")
    observation, _ = env.reset(seed=0, options={"region": "R1"})
    for _ in range(8):  # the gaze settles
        observation, *_ = env.step(command.rest().astype(np.float32))
    assert env.observation_space.contains(observation)
    head, overview = observation["pixels"]["head"], env.render()
    assert isinstance(overview, np.ndarray) and overview.shape == head.shape == (HEIGHT, WIDTH, 3)
    assert overview.dtype == np.uint8 and not np.array_equal(head, overview)

    def brown(image: np.ndarray) -> np.ndarray:
        red, _, blue = image.astype(int).transpose(2, 0, 1)
        return red > blue + 50

    rows, columns = np.nonzero(brown(head))
    assert abs(rows.mean() - HEIGHT / 2) < 60 and abs(columns.mean() - WIDTH / 2) < 60
    assert 100 < np.count_nonzero(brown(overview)) < overview[..., 0].size / 10
    again = env.render()
    assert again is not None and not np.shares_memory(again, overview)
    np.testing.assert_array_equal(again, overview)
    env.close()


def test_an_image_too_large_is_refused() -> None:
    env = DemoHLMEnv(controller=HoldController(1))
    with pytest.raises(SceneError, match="640x480"):
        Renderer(env.sim.model, 1920, 1080)
