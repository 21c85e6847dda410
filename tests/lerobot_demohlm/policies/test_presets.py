"""Presets: the paper's numbers, LeRobot's configurations, and one training whichever command runs it."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from safetensors.torch import load_file

from gym_demohlm.errors import DatasetError, PolicyError, UnknownNameError
from lerobot_demohlm import cli
from lerobot_demohlm.datasets import in_memory, writer
from lerobot_demohlm.datasets.facts import write_facts
from lerobot_demohlm.evaluation.evaluate import evaluate
from lerobot_demohlm.evaluation.loaded_policy import load_policy
from lerobot_demohlm.evaluation.rollouts import Setting
from lerobot_demohlm.policies import presets, training
from lerobot_demohlm.policies.presets import POLICIES, get_preset, policy_config, train_config
from tests.helpers.synthetic import make_episode, make_facts

SMALL: dict[str, dict[str, Any]] = {
    "mlp": {"hidden_dims": [8]},
    "act": {"dim_model": 8, "n_heads": 2, "dim_feedforward": 8, "n_decoder_layers": 1},
    "diffusion": {"down_dims": (8, 16), "n_groups": 4, "diffusion_step_embed_dim": 8},
}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("presets") / "data"
    episodes = [make_episode(index, length=22) for index in range(3)]
    writer.write_dataset(root, "local/data", episodes)
    write_facts(root, make_facts(num_attempts=3), [episode.record() for episode in episodes])
    return root


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the networks of the cpu presets tiny."""
    table = {
        key: replace(
            preset,
            batch_size=8,
            steps=3,
            options={**preset.options, **(SMALL[key[0]] if key[1] == "cpu" else {})},
        )
        for key, preset in presets.PRESETS.items()
    }
    monkeypatch.setattr(presets, "PRESETS", table)


def test_paper_presets_are_the_papers() -> None:
    """The tables of its appendix, with the one number that LeRobot refuses: a horizon of 20."""
    mlp, act, diffusion = (
        policy_config(get_preset(policy, "paper"), steps=100) for policy in ("mlp", "act", "diffusion")
    )
    batch_sizes = [get_preset(policy, "paper").batch_size for policy in ("mlp", "act", "diffusion")]
    assert batch_sizes == [512, 2048, 4096]
    for config in (mlp, act, diffusion):
        assert config.get_optimizer_preset().lr == 5e-5
        assert config.normalization_mapping["ENV"].value == "MEAN_STD"
        assert config.n_action_steps == 10
    assert (mlp.chunk_size, act.chunk_size, diffusion.horizon) == (20, 20, 24)
    assert mlp.hidden_dims == [512, 2048, 512]
    assert (act.n_encoder_layers, act.n_decoder_layers, act.n_heads, act.dim_model) == (2, 3, 8, 512)
    assert (act.dim_feedforward, act.latent_dim, act.kl_weight, act.use_vae) == (3200, 32, 10, True)
    assert (diffusion.down_dims, diffusion.kernel_size, diffusion.n_obs_steps) == ((256, 512, 1024), 5, 1)
    assert (diffusion.diffusion_step_embed_dim, diffusion.num_train_timesteps) == (256, 100)


@pytest.mark.parametrize("name", ["avx512_bf16", "amx_bf16", "avx2"])
def test_cpu_presets_train_in_bfloat16_where_the_processor_does(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {name: True})
    for preset, device, expected in (("cpu", "cpu", name != "avx2"), ("paper", "cpu", False), ("cpu", "cuda", False)):
        mlp, act, diffusion = (policy_config(get_preset(policy, preset), 100, device) for policy in POLICIES)
        assert mlp.dtype == ("bfloat16" if expected else "float32")
        assert not mlp.use_amp  # it acts in float32
        assert act.use_amp == diffusion.use_amp == expected
    act = get_preset("act", "cpu")
    assert not policy_config(replace(act, options={**act.options, "use_amp": False}), 100).use_amp, "an option counts"


def presets_of(policy: str) -> list[str]:
    """Return the names of a policy's presets."""
    return [name for kind, name in presets.PRESETS if kind == policy]


@pytest.mark.parametrize("name", presets_of("diffusion"))
def test_diffusion_tells_all_states_apart(name: str) -> None:
    """Its observations go to Mish as they are, which rises from -1.19 on only; a neck is seldom turned, but far."""
    config = policy_config(get_preset("diffusion", name), steps=100)
    config.input_features = {OBS_STATE: PolicyFeature(FeatureType.STATE, (1,))}
    config.output_features = {ACTION: PolicyFeature(FeatureType.ACTION, (1,))}
    stats = {"min": -0.7, "max": 0.7, "mean": 0.0, "std": 0.05}
    preprocessor, _ = make_pre_post_processors(
        config, dataset_stats={OBS_STATE: {kind: torch.tensor([value]) for kind, value in stats.items()}}
    )
    inputs = preprocessor({OBS_STATE: torch.linspace(-0.7, 0.7, 29)[:, None]})
    assert (torch.nn.functional.mish(inputs[OBS_STATE]).diff(dim=0) > 0).all()


@pytest.mark.parametrize("name", [name for name in presets_of("diffusion") if not name.startswith("vision")])
def test_diffusion_measures_objects_by_deviations(name: str) -> None:
    """Extremes are far out: a millimetre in meters of them is nothing, and Handover's cube falls beside the palm."""
    config = policy_config(get_preset("diffusion", name), steps=100)
    config.input_features = {OBS_ENV_STATE: PolicyFeature(FeatureType.ENV, (1,))}
    config.output_features = {ACTION: PolicyFeature(FeatureType.ACTION, (1,))}
    stats = {"min": -1.0, "max": 1.0, "mean": 0.5, "std": 0.1}
    preprocessor, _ = make_pre_post_processors(
        config, dataset_stats={OBS_ENV_STATE: {kind: torch.tensor([value]) for kind, value in stats.items()}}
    )
    inputs = preprocessor({OBS_ENV_STATE: torch.tensor([[0.5], [0.6]])})
    torch.testing.assert_close(inputs[OBS_ENV_STATE], torch.tensor([[0.0], [1.0]]))


def test_fields_of_the_preset_can_be_replaced(root: Path, tmp_path: Path) -> None:
    config = train_config(root, tmp_path / "out", batch_size=7, options={"hidden_dims": [16]})
    assert (config.policy.hidden_dims, config.policy.chunk_size, config.batch_size) == ([16], 20, 7)
    assert train_config(root, tmp_path / "out").policy.hidden_dims == [512, 2048, 512]


def test_unknown_names_and_counts_are_refused(root: Path, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="policy 'acd'"):
        get_preset("acd", "cpu")
    with pytest.raises(UnknownNameError, match="preset 'gpu'"):
        get_preset("act", "gpu")
    with pytest.raises(PolicyError, match="steps=0"):
        train_config(root, tmp_path / "out", steps=0)
    with pytest.raises(DatasetError, match="num_episodes=4"):
        training.train(tmp_path / "out", root, num_episodes=4)
    assert cli.main(["train", "--task", "LiftBox", "--output", str(tmp_path / "out")]) == 2
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("policy", POLICIES)
def test_configuration_is_read_back_as_it_was(policy: str, root: Path, tmp_path: Path) -> None:
    import draccus
    from lerobot.configs.train import TrainPipelineConfig

    for preset in (name for name in presets_of(policy) if not name.startswith("vision")):  # those need pictures
        file = tmp_path / f"{preset}.json"
        words = ["train", "--root", str(root), "--policy", policy, "--preset", preset, "--num-episodes", "2"]
        assert cli.main([*words, "--output", str(tmp_path / "out"), "--write-config", str(file)]) == 0
        read = TrainPipelineConfig.from_pretrained(file)
        assert draccus.encode(read) == draccus.encode(
            train_config(root, tmp_path / "out", policy, preset, num_episodes=2)
        )
        assert (read.dataset.episodes, read.num_workers) == ([0, 1], 0)
    assert not (tmp_path / "out").exists()


def test_a_configuration_may_be_for_another_machines_device(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "act.json"
    words = ["train", "--root", str(root), "--policy", "act", "--write-config", str(file), "--device"]
    assert cli.main([*words, "xpu"]) == 0
    assert json.loads(file.read_text())["policy"]["device"] == "xpu"
    assert cli.main([*words, "gpu"]) == 2
    assert "device 'gpu'" in capsys.readouterr().err


@pytest.mark.usefixtures("small")
def test_a_checkpoint_knows_its_dataset_from_wherever_it_is_scored(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(root.parent)
    path = training.train(tmp_path / "out", Path(root.name))
    other = tmp_path / "elsewhere" / root.name / "meta"
    other.mkdir(parents=True)
    (other / "info.json").write_text('{"total_episodes": 99}')
    (other / "demohlm.json").write_text('{"task": "PushCube"}')
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert load_policy(path, "LiftBox").num_train_episodes == 3
    with pytest.raises(PolicyError, match="a policy trained on LiftBox"):
        load_policy(path, "PressCube")


@pytest.mark.usefixtures("small")
def test_an_output_that_cannot_be_made_is_refused_before_the_training(root: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for output in (tmp_path / "file" / "out", Path("/proc/out")):
        with pytest.raises(DatasetError, match="choose another --output"):
            training.train(output, root)


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("policy", POLICIES)
def test_a_checkpoint_is_lerobots_and_acts(policy: str, root: Path, tmp_path: Path) -> None:
    path = training.train(tmp_path / "out", root, policy, seed=5, num_episodes=2)
    saved = json.loads((path / "train_config.json").read_text())
    assert (saved["seed"], saved["steps"], saved["dataset"]["episodes"]) == (5, 3, [0, 1])
    loaded = load_policy(path, "LiftBox")
    assert (loaded.kind, loaded.num_train_episodes, loaded.train_seed) == (get_preset(policy, "cpu").type, 2, 5)
    seen = {
        "observation.state": torch.zeros(2, 68),
        "observation.environment_state": torch.zeros(2, 9),
        "task": ["Lift the box."] * 2,
    }
    with torch.inference_mode():
        actions = loaded.postprocessor(loaded.policy.select_action(loaded.preprocessor(seen)))
    assert actions.shape == (2, 23)
    assert torch.isfinite(actions).all()


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("policy", POLICIES)
def test_lerobot_train_is_the_same_training(
    policy: str, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bit for bit, from the file written before or the one in the checkpoint, with the data in memory or on disk."""
    from lerobot.datasets import LeRobotDataset, factory
    from lerobot.scripts import lerobot_train

    ours = load_file(training.train(tmp_path / "ours", root, policy, seed=5) / "model.safetensors")
    before = tmp_path / "before.json"
    training.write_config(before, train_config(root, tmp_path / "unused", policy, seed=5))
    after = tmp_path / "ours/checkpoints/last/pretrained_model/train_config.json"
    for name, file, switch in (("before", before, "1"), ("after", after, "1"), ("disk", before, "0")):
        monkeypatch.setattr(factory, "LeRobotDataset", LeRobotDataset)
        monkeypatch.setenv(in_memory.SWITCH, switch)
        monkeypatch.setattr(sys, "argv", ["lerobot-train", f"--config_path={file}", f"--output_dir={tmp_path / name}"])
        monkeypatch.delitem(sys.modules, "lerobot_env_demohlm", raising=False)
        lerobot_train.main()  # finds the plugin, which installs what reads from memory
        assert (factory.LeRobotDataset is LeRobotDataset) == (name == "disk")
        theirs = load_file(tmp_path / name / "checkpoints/last/pretrained_model/model.safetensors")
        assert theirs.keys() == ours.keys()
        assert all(torch.equal(theirs[key], value) for key, value in ours.items()), name


@pytest.mark.usefixtures("small")
def test_a_training_has_its_own_precision(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not that of the one before it in the same process: accelerate remembers."""
    from accelerate.state import AcceleratorState

    found = []
    for index, policy in enumerate(("mlp", "diffusion", "act", "mlp", "diffusion")):
        monkeypatch.setattr(presets, "has_bfloat16", lambda index=index: index % 2 == 0)
        training.train(tmp_path / str(index), root, policy)
        found.append(AcceleratorState().mixed_precision)
    assert found == ["bf16", "no", "bf16", "no", "bf16"]


@pytest.mark.slow
@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("policy", ["act", "diffusion"])
def test_rollouts_of_lerobots_policies(policy: str, root: Path, tmp_path: Path) -> None:
    loaded = load_policy(training.train(tmp_path / "out", root, policy), "LiftBox")
    setting = Setting(task="LiftBox", region="R1", num_worlds=2)
    whole = evaluate(loaded, setting, [3, 4], tmp_path / "one.jsonl")
    (tmp_path / "two.jsonl").write_text((tmp_path / "one.jsonl").read_text().splitlines(keepends=True)[0])
    assert evaluate(loaded, setting, [3, 4], tmp_path / "two.jsonl") == whole
