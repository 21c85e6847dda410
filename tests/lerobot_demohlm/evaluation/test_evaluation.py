"""Rollouts: seeded, in order, the same alone and in a batch; records, intervals, and what a checkpoint must be."""

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gym_demohlm import jsonl
from gym_demohlm.envs.vector_env import DemoHLMVectorEnv
from gym_demohlm.errors import DatasetError, PolicyError
from gym_demohlm.registry import get_task, register_task
from lerobot_demohlm import cli
from lerobot_demohlm.evaluation import evaluate as evaluation
from lerobot_demohlm.evaluation import loaded_policy, rollouts
from lerobot_demohlm.evaluation.evaluate import evaluate, read_rollouts, resumed_rollouts, summarize, wilson
from lerobot_demohlm.evaluation.loaded_policy import LoadedPolicy, load_policy, policy_hash
from lerobot_demohlm.evaluation.rollout import Rollout
from lerobot_demohlm.evaluation.rollouts import Setting
from tests.helpers import outside
from tests.helpers.checkpoints import save_policy

BRIEF = replace(get_task("LiftBox"), name="LiftBoxHalfSecond", episode_length_s=0.5)
TASK = BRIEF.name


@pytest.fixture(autouse=True)
def brief_task(known_tasks: None) -> None:
    """Make the brief task known to each test of this file alone."""
    register_task(BRIEF)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_policy(tmp_path_factory.mktemp("policy") / "pretrained_model")


@pytest.fixture(scope="module")
def restless(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a policy whose actions depend on what it sees."""
    return save_policy(tmp_path_factory.mktemp("restless") / "pretrained_model", scale=0.2)


def played(loaded: LoadedPolicy, seeds: list[int], **kwargs: int) -> tuple[list[dict], np.ndarray]:
    """Roll out and return the records and the physics states of every step (steps, worlds, size)."""
    states: list[np.ndarray] = []
    setting = Setting(task=TASK, region="R1", **kwargs)
    found = rollouts.rollouts(
        loaded, setting, seeds, on_step=lambda env, going: states.append(env.sim.snapshot()["physics"])
    )
    return list(found), np.stack(states)


@pytest.mark.parametrize("use_amp", [False, True])
def test_a_policy_acts_in_the_precision_it_was_trained_in(use_amp: bool, checkpoint: Path) -> None:
    loaded = load_policy(checkpoint, TASK)
    loaded.policy.config.use_amp = use_amp
    select, seen = loaded.policy.select_action, []

    def watched(batch: dict) -> torch.Tensor:
        seen.append(torch.is_autocast_enabled("cpu"))
        return select(batch)

    loaded.policy.select_action = watched  # type: ignore[method-assign]
    played(loaded, [7])
    assert set(seen) == {use_amp}


def test_rollouts_are_seeded_and_the_same_alone_and_in_a_batch(restless: Path) -> None:
    loaded = load_policy(restless, TASK)
    seeds = [7, 8, 9]
    batched, states = played(loaded, seeds, num_worlds=2)  # the last batch has one world too many
    for place, seed in enumerate(seeds):
        alone, own_states = played(loaded, [seed])
        assert alone == [batched[place]]
        batch, world = divmod(place, 2)
        np.testing.assert_array_equal(states[6 * batch : 6 * batch + 6, world], own_states[:, 0])
    assert [record.seed for record in batched] == seeds
    env = DemoHLMVectorEnv(num_envs=1, task=TASK, region="R1")
    for record in batched:
        start = env.reset(seed=record.seed)[1]["initial_state"]
        assert record.initial_state == {name: [float(v) for v in start[name][0]] for name in ("robot", "object")}
        assert record.length_s == 0.5
        assert record.outcome == "timeout"
        assert not record.success_held
        assert (record.policy, record.num_train_episodes, record.train_seed) == ("chunked_mlp", None, None)
    env.close()
    assert batched[0].initial_state != batched[1].initial_state
    assert [jsonl.parse(Rollout, json.loads(jsonl.encode(asdict(rollout))), "") for rollout in batched] == batched


def test_observer_sees_every_step(checkpoint: Path) -> None:
    seen: list[list[bool]] = []
    setting = Setting(task=TASK, region="R1")
    loaded = load_policy(checkpoint, TASK)
    list(rollouts.rollouts(loaded, setting, [1, 2], on_step=lambda env, going: seen.append(going.tolist())))
    assert seen == [[True, True]] * 5 + [[False, False]]


def test_command_line(checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "new" / "rollouts.jsonl"
    arguments = ["evaluate", "--policy", str(checkpoint), "--task", TASK, "--region", "R2", "--num-episodes", "2"]
    assert cli.main([*arguments, "--output", str(output)]) == 0
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (summary["task"], summary["region"], summary["episodes"]) == (TASK, "R2", 2)
    assert summary["success_held"]["rate"] == 0
    assert summary["outcomes"]["timeout"] == 2
    assert [record.seed for record in read_rollouts(output)] == [evaluation.FIRST_SEED, evaluation.FIRST_SEED + 1]
    assert cli.main([*arguments, "--output", str(output)]) == 0  # nothing is left to do
    assert len(read_rollouts(output)) == 2
    arguments[arguments.index("R2")] = "R1"
    assert cli.main([*arguments, "--output", str(output)]) == 2
    assert "region=R2" in capsys.readouterr().err
    assert cli.main([*arguments, "--num-worlds", "0"]) == 2
    assert cli.main(["evaluate", "--policy", str(checkpoint), "--task", TASK, "--region", "R7"]) == 2
    assert cli.main(["evaluate", "--policy", str(tmp_path), "--task", TASK]) == 2
    assert capsys.readouterr().err.count("error: ") == 3


def test_a_file_that_cannot_be_written_is_said_before_any_rollout(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("lerobot_demohlm.evaluation.evaluate.roll_batches", lambda *_, **__: pytest.fail("rolled out"))
    (tmp_path / "notes").write_text("")
    there = tmp_path / "notes" / "rollouts.jsonl"
    assert cli.main(["evaluate", "--policy", str(checkpoint), "--task", TASK, "--output", str(there)]) == 2
    assert f"got {there.parent} (File exists)" in capsys.readouterr().err


def test_checkpoints_that_do_not_fit_are_refused(checkpoint: Path, tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=r"config\.json"):
        load_policy(tmp_path, TASK)
    with pytest.raises(PolicyError, match=r"observation\.state \(67,\)"):
        load_policy(save_policy(tmp_path / "narrow", state_size=67), TASK)
    nested = tmp_path / "training" / "checkpoints" / "last"
    nested.mkdir(parents=True)
    (nested / "pretrained_model").symlink_to(checkpoint)
    with pytest.raises(PolicyError, match=r"name .*training/checkpoints/last/pretrained_model"):
        load_policy(tmp_path / "training", TASK)
    for device, message in (("cuba", "cpu, cuda, mps or xpu"), ("xpu", "finds on this machine")):
        with pytest.raises(PolicyError, match=message):
            load_policy(checkpoint, TASK, device)
    unknown = tmp_path / "unknown"
    unknown.mkdir()
    for file in checkpoint.iterdir():
        (unknown / file.name).write_bytes(file.read_bytes())
    content = json.loads((unknown / "config.json").read_text())
    (unknown / "config.json").write_text(json.dumps(content | {"type": "oracle"}))
    with pytest.raises(PolicyError, match="oracle"):
        load_policy(unknown, TASK)


@pytest.mark.parametrize(
    "damage", ["model.safetensors", "policy_preprocessor.json", "policy_postprocessor.json", "train_config.json"]
)
def test_a_damaged_checkpoint_is_said_to_be(damage: str, checkpoint: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(checkpoint, copy)
    whole = (copy / damage).read_bytes() if (copy / damage).exists() else b"{}"
    (copy / damage).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(PolicyError, match=r"damaged|no JSON"):
        load_policy(copy, TASK)
    if damage.startswith("policy_"):
        (copy / damage).unlink()
        with pytest.raises(PolicyError, match="damaged"):
            load_policy(copy, TASK)


def test_a_policy_of_another_tasks_dataset_is_refused(tmp_path: Path) -> None:
    policy, facts = save_policy(tmp_path / "policy"), tmp_path / "data" / "meta" / "demohlm.json"
    facts.parent.mkdir(parents=True)
    trained = {"dataset": {"root": str(tmp_path / "data")}, "env": {"task": "LiftBox-v0"}}
    (policy / "train_config.json").write_text(json.dumps(trained))
    load_policy(policy, "PressCube")  # its dataset is not there, or has several tasks: nobody knows
    facts.write_text(json.dumps({"task": "LiftBox"}))
    load_policy(policy, "LiftBox")
    with pytest.raises(PolicyError, match="a policy trained on LiftBox; expected one for PressCube; check --task"):
        load_policy(policy, "PressCube")
    for file in (facts, facts.with_name("info.json")):
        for content in ('{"task": "Lift', "[]"):  # damaged: nobody knows
            file.write_text(content)
            assert load_policy(policy, "PressCube").num_train_episodes is None
    (policy / "train_config.json").write_text("[]")
    with pytest.raises(PolicyError, match=r"train_config\.json, damaged"):
        load_policy(policy, "PressCube")


def test_policy_hash_is_of_what_decides_actions(checkpoint: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    copy.mkdir()
    for file in checkpoint.iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    original = policy_hash(checkpoint)
    (copy / "train_config.json").write_text("{}")
    assert policy_hash(copy) == original
    weights = copy / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1] + b"\x01")
    assert policy_hash(copy) != original


def test_number_of_training_episodes_is_read_where_it_is_known(tmp_path: Path) -> None:
    def count(dataset: dict) -> int | None:
        return loaded_policy._num_train_episodes({"dataset": dataset})

    (tmp_path / "data/meta").mkdir(parents=True)
    (tmp_path / "data/meta/info.json").write_text('{"total_episodes": 12}')
    assert count({"root": str(tmp_path / "data"), "episodes": None}) == 12
    assert count({"root": str(tmp_path / "data"), "episodes": [0, 3]}) == 2
    assert count({"root": str(tmp_path / "gone"), "episodes": None}) is None
    assert count({"root": None, "episodes": None}) is None
    assert count({}) is None


@pytest.mark.parametrize(
    ("flags", "outcome"),
    [
        ({"success_held"}, "success"),
        ({"success_held", "collided"}, "success"),
        ({"fell", "dropped"}, "fell"),
        ({"unstable"}, "fell"),
        ({"dropped", "collided"}, "collided"),
        ({"dropped"}, "dropped"),
        ({"spilled"}, "dropped"),
        ({"collided"}, "collided"),
        (set(), "timeout"),
    ],
)
def test_outcome_names_what_went_wrong_worst(flags: set[str], outcome: str) -> None:
    names = ("success_held", "fell", "unstable", "collided", "dropped", "spilled")
    assert rollouts._outcome({name: name in flags for name in names}, ("dropped", "spilled")) == outcome


def test_wilson_intervals() -> None:
    # Reference values: Newcombe (1998), Statistics in Medicine 17, table I, method 3.
    np.testing.assert_allclose(wilson(81, 263), (0.2553, 0.3662), atol=1e-4)
    np.testing.assert_allclose(wilson(15, 148), (0.0624, 0.1605), atol=1e-4)
    np.testing.assert_allclose(wilson(0, 20), (0.0, 0.1611), atol=1e-4)
    np.testing.assert_allclose(wilson(1, 29), (0.0061, 0.1718), atol=1e-4)
    for count in (1, 7, 50):
        for successes in range(count + 1):
            low, high = wilson(successes, count)
            assert 0 <= low <= successes / count <= high <= 1
            np.testing.assert_allclose(wilson(count - successes, count), (1 - high, 1 - low), atol=1e-12)
    for wrong in ((0, 0), (3, 2), (-1, 2)):
        with pytest.raises(ValueError, match="successes of"):
            wilson(*wrong)


def test_records_on_disk(tmp_path: Path) -> None:
    held = Rollout(
        task=TASK,
        policy="chunked_mlp",
        policy_hash="0" * 64,
        region="R1",
        seed=3,
        success_ever=True,
        success_end=True,
        success_held=True,
        success_strict=True,
        outcome="success",
        length_s=0.5,
        initial_state={"robot": [0.0, 0.0, 0.0]},
    )
    failed = replace(held, seed=4, outcome="fell", success_held=False, success_end=False, success_strict=False)
    path = tmp_path / "rollouts.jsonl"
    jsonl.append(path, map(asdict, [held, failed]))
    assert read_rollouts(path) == [held, failed]
    summary = summarize(read_rollouts(path))
    assert [summary[name]["rate"] for name in evaluation.SUCCESSES] == [0.5, 0.5, 0.5, 1.0]
    for content in ("", "{", "[1]", '{"outcome": "won"}', jsonl.encode(asdict(held) | {"outcome": "won"})):
        path.write_text(content)
        with pytest.raises(DatasetError, match=path.name):
            read_rollouts(path)


def test_a_killed_evaluation_goes_on(restless: Path, tmp_path: Path) -> None:
    loaded, setting = load_policy(restless, TASK), Setting(task=TASK, region="R1", num_worlds=2)
    whole = evaluate(loaded, setting, [3, 4, 5], tmp_path / "whole.jsonl")
    assert [record.seed for record in whole] == [3, 4, 5]
    lines = (tmp_path / "whole.jsonl").read_bytes().splitlines(keepends=True)
    torn = tmp_path / "torn.jsonl"
    for kept in (lines[0] + lines[1][:-1], lines[0] + lines[1] + lines[2][:5]):
        torn.write_bytes(kept)
        assert evaluate(loaded, setting, [3, 4, 5], torn) == whole
        assert sorted(torn.read_bytes().splitlines(keepends=True)) == sorted(lines)
    assert evaluate(loaded, setting, [3, 4], tmp_path / "late.jsonl", deadline=0.0) == []
    assert resumed_rollouts(tmp_path / "late.jsonl", {}) == []
    torn.write_bytes(lines[0][:40])
    assert (resumed_rollouts(torn, {}), torn.read_bytes()) == ([], b"")
    torn.write_bytes(lines[0])
    with pytest.raises(DatasetError, match="choose another --output"):
        evaluate(loaded, Setting(task=TASK, region="R2"), [3], torn)


def test_an_edited_task_from_outside_does_not_go_on_with_its_old_rollouts(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    loaded, output = load_policy(checkpoint, TASK), tmp_path / "rollouts.jsonl"

    def found(after_s: float) -> list[Rollout]:
        setting = Setting(task=outside.bring_task(tmp_path, after_s).name, region="R1")
        return evaluate(loaded, setting, [3], output)

    first = found(0.2)
    assert first[0].success_ever
    with pytest.raises(DatasetError, match="with rollouts of code="):
        found(9.0)
    assert found(0.2) == first


@pytest.mark.parametrize("name", ["real@0", "none@1", "hard@0:pushes"])
def test_what_varies_nothing_is_the_plain_world_and_goes_on(name: str, checkpoint: Path, tmp_path: Path) -> None:
    from lerobot_demohlm.evaluation.env_config import DemoHLMEnvConfig

    plain, same = (Setting(task=TASK, region="R1", variation=variation) for variation in ("none", name))
    assert same == plain
    assert DemoHLMEnvConfig(task=TASK, variation=name).gym_kwargs["variation"] == "none"
    loaded, output = load_policy(checkpoint, TASK), tmp_path / "rollouts.jsonl"
    first = evaluate(loaded, same, [3], output)
    assert evaluate(loaded, Setting(task=TASK, region="R1", variation=name), [3], output) == first
    assert evaluate(loaded, plain, [3], output) == first


@pytest.mark.parametrize("use_async", [False, True])
def test_lerobots_environments_draw_pictures_of_the_size_that_a_policy_needs(use_async: bool) -> None:
    from lerobot_demohlm.evaluation.env_config import DemoHLMEnvConfig

    config = DemoHLMEnvConfig(task="LiftBox", obs_type="pixels_agent_pos", image_width=48, image_height=36)
    assert config.features["pixels/head"].shape == (36, 48, 3)
    (envs,) = config.create_envs(2, use_async_envs=use_async)["LiftBox"].values()
    assert envs.single_observation_space["pixels"]["head"].shape == (36, 48, 3)  # type: ignore[index]
    if not use_async:
        drawn = DemoHLMVectorEnv(num_envs=2, task="LiftBox", obs_type="pixels_agent_pos", image_size=(48, 36))
        pictures = [made.reset(seed=[3, 4])[0]["pixels"]["head"] for made in (envs, drawn)]
        np.testing.assert_array_equal(*pictures)
        drawn.close()
    envs.close()
    with pytest.raises(ValueError, match="0 x 36 pixels"):
        DemoHLMEnvConfig(task="LiftBox", obs_type="pixels_agent_pos", image_width=0, image_height=36)


def test_workers_give_the_same_lines(restless: Path) -> None:
    loaded = load_policy(restless, TASK)
    seeds = [3, 4, 5]
    one = list(rollouts.rollouts(loaded, Setting(task=TASK, region="R1"), seeds))
    two = list(rollouts.rollouts(loaded, Setting(task=TASK, region="R1", num_worlds=2, num_workers=2), seeds))
    assert one == two
    with pytest.raises(PolicyError, match="num_workers=2"):
        played(loaded, seeds, num_workers=2)


def test_lerobots_rollout_is_ours(restless: Path) -> None:
    """LeRobot's own loop, with processors and environments as ``lerobot-eval`` makes them, ends in the same states."""
    from lerobot.envs import make_env_pre_post_processors
    from lerobot.scripts.lerobot_eval import rollout

    from lerobot_demohlm.evaluation.env_config import DemoHLMEnvConfig

    loaded = load_policy(restless, TASK)
    records, states = played(loaded, [11, 12, 13])
    config = DemoHLMEnvConfig(task=TASK, region="R1")
    for batch in ([11, 12], [13]):  # other batches than ours
        env = config.create_envs(len(batch))[TASK][0]
        ours = states[:, [seed - 11 for seed in batch]]
        seen: list[np.ndarray] = []
        pre, post = make_env_pre_post_processors(config, loaded.policy.config)
        result = rollout(
            env,
            loaded.policy,
            pre,
            post,
            loaded.preprocessor,
            loaded.postprocessor,
            seeds=batch,
            render_callback=lambda env, seen=seen: seen.append(env.sim.snapshot()["physics"]),
        )
        env.close()
        np.testing.assert_array_equal(np.stack(seen), ours)
        assert result["success"].any(dim=1).tolist() == [records[seed - 11].success_held for seed in batch]
    assert not np.array_equal(ours[1], ours[-1])


@pytest.mark.slow
def test_benchmark_beside_lerobot_eval(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["benchmark", "evaluation", "--num-episodes", "3", "--num-lerobot-episodes", "2", "--region", "R1"]
    assert cli.main(words) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (found["compared"], found["agreeing"]) == (2, 2)
    assert found["ratio"] > 1
    assert cli.main([*words, "--num-workers", "0"]) == 2
