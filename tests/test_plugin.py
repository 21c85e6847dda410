"""The plugin: LeRobot finds it by itself, and what it finds fits the environments and the packages on disk."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from lerobot.configs import FeatureType
from lerobot.envs import env_to_policy_features, make_env_config

import lerobot_demohlm
from gym_demohlm.errors import UnknownNameError
from gym_demohlm.registry import all_tasks
from tests.helpers.paths import REPOSITORY

lerobot_demohlm.register()


@pytest.mark.parametrize(
    "registration",
    [
        "from lerobot.utils.import_utils import register_third_party_plugins as f; f()",
        "from lerobot.configs.parser import load_plugin as f; f('lerobot_demohlm')",
    ],
)
def test_lerobot_finds_environment_and_policy(registration: str, tmp_path: Path) -> None:
    code = (
        f"{registration}\n"
        "from lerobot.configs import PreTrainedConfig\n"
        "from lerobot.envs import EnvConfig\n"
        "assert 'demohlm' in EnvConfig.get_known_choices()\n"
        "assert 'chunked_mlp' in PreTrainedConfig.get_known_choices()\n"
    )
    environment = os.environ | {"PYTHONPATH": "", "LOGLEVEL": "ERROR"}
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path, env=environment)


def test_importing_the_package_alone_is_cheap() -> None:
    code = "import sys, lerobot_demohlm; assert not {'torch', 'lerobot', 'gymnasium'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_package_is_installed() -> None:
    """Folders of code without an ``__init__.py`` would be left out of the wheel."""
    folders = {
        path.parent
        for package in ("gym_demohlm", "lerobot_demohlm", "lerobot_env_demohlm")
        for path in (REPOSITORY / package).rglob("*.py")
    }
    assert [folder for folder in sorted(folders) if not (folder / "__init__.py").exists()] == []


@pytest.mark.parametrize("task", all_tasks())
def test_features_are_those_of_the_environment(task: str) -> None:
    config = make_env_config("demohlm", task=f"{task}-v0", region="R1")
    features = env_to_policy_features(config)
    environments = config.create_envs(n_envs=2)
    assert list(environments) == [task]
    vector = environments[task][0]
    try:
        spaces = vector.single_observation_space.spaces
        assert features["observation.state"].shape == spaces["agent_pos"].shape
        assert features["observation.environment_state"].shape == spaces["environment_state"].shape
        assert features["observation.environment_state"].type is FeatureType.ENV
        assert features["action"].shape == vector.single_action_space.shape
        assert vector.num_envs == 2
        assert vector.call("task_description")[1] == all_tasks()[task].description
        assert config.fps == vector.metadata["render_fps"]
    finally:
        vector.close()


def test_images_are_features_on_request() -> None:
    config = make_env_config("demohlm", task="LiftBox-v0", obs_type="pixels_agent_pos")
    features = env_to_policy_features(config)
    assert features["observation.images.head"].shape == (3, 480, 640)
    assert "observation.environment_state" in features


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"task": "LiftBx-v0"}, "did you mean 'LiftBox'"),
        ({"region": "R9"}, "region 'R9'"),
        ({"obs_type": "smell"}, "obs_type 'smell'"),
    ],
)
def test_unknown_names_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(UnknownNameError, match=message):
        make_env_config("demohlm", **changes)


@pytest.mark.slow
def test_async_environments_equal_those_in_one_process() -> None:
    import numpy as np

    config = make_env_config("demohlm", task="LiftBox-v0", region="R1")
    results = []
    for use_async in (False, True):
        vector = config.create_envs(n_envs=2, use_async_envs=use_async)["LiftBox"][0]
        try:
            assert vector.call("_max_episode_steps")[0] > 0
            seen = [vector.reset(seed=[3, 4])[0]]
            actions = np.stack([vector.single_action_space.low, vector.single_action_space.high]) * 0.1
            for _ in range(3):
                observation, _, _, _, info = vector.step(actions)
                assert info["is_success"].tolist() == [False, False]
                seen.append(observation)
            results.append(seen)
        finally:
            vector.close()
    for one, other in zip(*results, strict=True):
        for key in ("agent_pos", "environment_state"):
            np.testing.assert_array_equal(one[key], other[key])
