"""Datasets: what is written is what LeRobot reads; a killed run ends in the same dataset as one never killed."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import get_task
from lerobot_demohlm.datasets import facts, merge, writer
from lerobot_demohlm.datasets.episode import Episode
from lerobot_demohlm.datasets.facts import GenerationFacts
from lerobot_demohlm.datasets.origin import read_origins
from lerobot_demohlm.generation.block import write_block
from lerobot_demohlm.generation.run import GenerationRun, failures_root, partial_directory
from lerobot_demohlm.reproducibility import provenance
from tests.helpers.paths import REPOSITORY
from tests.helpers.synthetic import make_episode, make_facts


def outcome_of(index: int) -> str:
    """Let every third attempt fail."""
    return "fell" if index % 3 == 2 else "success"


def episode_of(index: int) -> Episode:
    return make_episode(index, outcome=outcome_of(index), length=5 + index)


def compute(run: GenerationRun, attempts: range) -> None:
    write_block(run.directory, run.facts, attempts, [episode_of(index) for index in attempts])


def generate(root: Path, facts: GenerationFacts) -> dict:
    run = GenerationRun.open(root, "user/name", facts)
    for attempts in run.pending_blocks():
        compute(run, attempts)
    return run.finish()


def files(root: Path) -> dict[str, bytes]:
    """Return every file of a dataset by its path."""
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def test_round_trip_through_lerobot(tmp_path: Path) -> None:
    from lerobot.datasets import LeRobotDataset

    content = generate(tmp_path / "data", make_facts())
    opened = LeRobotDataset("user/name", root=tmp_path / "data", delta_timestamps={"action": [0.0, 0.1]})
    episodes = [episode_of(index) for index in range(10) if outcome_of(index) == "success"]
    assert opened.num_episodes == len(episodes) == content["successes"]
    assert opened.num_frames == sum(len(episode.success) for episode in episodes)
    assert opened.meta.robot_type == "unitree_g1"
    assert opened.fps == 10
    assert opened.features["observation.state"]["names"] == list(observation.STATE_NAMES)
    assert opened.features["action"]["names"] == list(command.NAMES)
    environment_names = opened.features["observation.environment_state"]["names"]
    assert environment_names == list(observation.environment_names(get_task("LiftBox")))
    start = 0
    for episode in episodes:
        last = len(episode.success) - 1
        for step in (0, last):
            item = opened[start + step]
            np.testing.assert_array_equal(item["observation.state"], episode.state[step])
            np.testing.assert_array_equal(item["observation.environment_state"], episode.environment_state[step])
            np.testing.assert_array_equal(item["action"][0], episode.action[step])
            np.testing.assert_array_equal(item["action_is_pad"], [False, step == last])
            assert item["task"] == episode.task_text
            assert bool(item["next.success"]) == bool(episode.success[step])
            assert float(item["timestamp"]) == pytest.approx(step / 10)
        start += last + 1
    actions = np.concatenate([episode.action for episode in episodes])
    np.testing.assert_allclose(opened.meta.stats["action"]["mean"], actions.mean(axis=0), atol=1e-5)
    np.testing.assert_allclose(opened.meta.stats["action"]["std"], actions.std(axis=0), atol=1e-4)


def test_written_content_equals_that_of_lerobots_writer(tmp_path: Path) -> None:
    from lerobot.datasets import LeRobotDataset

    episodes = [make_episode(index, length=4 + index) for index in range(3)]
    writer.write_dataset(tmp_path / "ours", "user/name", episodes)
    theirs = LeRobotDataset.create(
        "user/name", 10, writer.features("LiftBox"), tmp_path / "theirs", "unitree_g1", use_videos=False
    )
    for episode in episodes:
        for step in range(len(episode.success)):
            theirs.add_frame(
                {
                    "observation.state": episode.state[step],
                    "observation.environment_state": episode.environment_state[step],
                    "action": episode.action[step],
                    "next.success": episode.success[step : step + 1],
                    "task": episode.task_text,
                }
            )
        theirs.save_episode()
    theirs.finalize()
    for path in ("data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet", "meta/tasks.parquet"):
        ours, reference = pq.read_table(tmp_path / "ours" / path), pq.read_table(tmp_path / "theirs" / path)
        more = [name for name in ours.column_names if name not in reference.column_names]
        assert more == (list(episodes[0].labels()) if "episodes" in path else [])
        ours = ours.drop_columns(more)
        assert ours.schema.equals(reference.schema)
        assert ours.equals(reference), path
    for path in ("meta/info.json", "meta/stats.json"):
        ours, reference = (json.loads((tmp_path / who / path).read_text()) for who in ("ours", "theirs"))
        assert ours == reference


def test_merge_equals_that_of_lerobot(tmp_path: Path) -> None:
    from lerobot.datasets import aggregate_datasets

    parts = [tmp_path / f"part{number}" for number in range(3)]
    for number, part in enumerate(parts):
        episodes = [make_episode(3 * number + i, length=4 + i) for i in range(number + 1)]
        writer.write_dataset(part, "a/b", episodes)
    merge.merge(parts, "user/name", tmp_path / "ours")
    aggregate_datasets(["a/b"] * 3, "user/name", roots=parts, aggr_root=tmp_path / "theirs")
    for path in ("data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"):
        ours, reference = (pq.read_table(tmp_path / who / path).to_pydict() for who in ("ours", "theirs"))
        assert list(ours) == list(reference)
        for name, values in reference.items():
            if name in ("tasks", *make_episode(0).labels()):
                assert ours[name] == values
            else:
                np.testing.assert_allclose(ours[name], values, rtol=1e-12, atol=1e-12, err_msg=name)
    for path in ("meta/info.json", "meta/stats.json"):
        ours, reference = (json.loads((tmp_path / who / path).read_text()) for who in ("ours", "theirs"))
        assert ours == reference


def test_merge_rotates_files(tmp_path: Path) -> None:
    from lerobot.datasets import LeRobotDataset

    parts = [tmp_path / f"part{number}" for number in range(3)]
    for number, part in enumerate(parts):
        writer.write_dataset(part, "a/b", [make_episode(number)])
    merge.merge(parts, "user/name", tmp_path / "merged", file_size_mb=1e-6)
    assert len(list((tmp_path / "merged/data").rglob("*.parquet"))) == 3
    opened = LeRobotDataset("user/name", root=tmp_path / "merged")
    np.testing.assert_array_equal(opened[24]["action"], make_episode(2).action[0])


def test_merge_refuses_another_task(tmp_path: Path) -> None:
    for number, text in enumerate(("Lift the box.", "Drop it.")):
        writer.write_dataset(tmp_path / str(number), "a/b", [make_episode(number, text=text)])
    with pytest.raises(DatasetError, match="one task"):
        merge.merge([tmp_path / "0", tmp_path / "1"], "user/name", tmp_path / "merged")


def test_facts_and_card(tmp_path: Path) -> None:
    generate(tmp_path / "data", make_facts())
    kept = facts.read_facts(tmp_path / "data")
    assert (kept["attempts"], kept["successes"], kept["outcomes"]["fell"]) == (10, 7, 3)
    assert kept["success_rate"] == 0.7
    assert kept["versions"]["lerobot"].startswith("0.6")
    records = facts.read_attempts(tmp_path / "data")
    assert [record["attempt"] for record in records] == list(range(10))
    assert [record["outcome"] for record in records] == [outcome_of(index) for index in range(10)]
    assert records[3]["initial_state"] == episode_of(3).initial_state
    card = (tmp_path / "data/README.md").read_text()
    assert card.startswith("---\nlicense: apache-2.0\n")
    for text in ('LeRobotDataset("user/name")', "| Attempts | 10 |", "| Failed: fell | 3 |", "left_elbow.pos"):
        assert text in card


def test_order_of_blocks_does_not_matter(tmp_path: Path) -> None:
    generate(tmp_path / "forward", make_facts())
    run = GenerationRun.open(tmp_path / "backward", "user/name", make_facts())
    for attempts in reversed(list(run.pending_blocks())):
        compute(run, attempts)
    run.finish()
    assert files(tmp_path / "forward") == files(tmp_path / "backward")


def test_episode_target_counts_attempts_up_to_its_last_success_only(tmp_path: Path) -> None:
    run = GenerationRun.open(tmp_path / "data", "user/name", make_facts(num_attempts=None, num_episodes=4))
    for block in (2, 1, 0):  # block 2 is computed in vain, as by a worker that was ahead
        compute(run, run.attempts_of_block(block))
    assert list(run.pending_blocks()) == []
    assert [record["attempt"] for record in run.records()] == [0, 1, 2, 3, 4]
    content = run.finish()
    assert (content["attempts"], content["successes"]) == (5, 4)
    arrays = list(writer.read_arrays(tmp_path / "data"))
    for array, index in zip(arrays, (0, 1, 3, 4), strict=True):
        np.testing.assert_array_equal(array["action"], episode_of(index).action)
    records = facts.read_attempts(tmp_path / "data")
    assert [origin.record for origin in read_origins(tmp_path / "data").values()] == [records[i] for i in (0, 1, 3, 4)]


def test_an_episode_comes_back_from_its_record() -> None:
    for episode in (make_episode(1), make_episode(2, outcome="fell")):
        rest = {
            name: getattr(episode, name)
            for name in ("task", "task_text", "seed", "region", "state", "environment_state", "action", "success")
        }
        assert Episode.of_record(episode.record(), **rest).record() == episode.record()


def test_failures_are_kept_on_request(tmp_path: Path) -> None:
    generate(tmp_path / "data", make_facts(keep_failures=True))
    arrays = list(writer.read_arrays(failures_root(tmp_path / "data")))
    for array, index in zip(arrays, (2, 5, 8), strict=True):
        np.testing.assert_array_equal(array["observation.state"], episode_of(index).state)
    assert not failures_root(tmp_path / "data").joinpath("merged").exists()


@pytest.mark.slow
def test_killed_while_writing_then_resumed_equals_never_killed(tmp_path: Path) -> None:
    root = tmp_path / "killed"
    script = (
        "import sys, time; from pathlib import Path; import tests.lerobot_demohlm.datasets.test_dataset as t\n"
        "from tests.helpers.synthetic import make_facts\n"
        "from lerobot_demohlm.datasets import writer\n"
        "run = t.GenerationRun.open(Path(sys.argv[1]), 'user/name', make_facts())\n"
        "compute = iter(run.pending_blocks())\n"
        "t.compute(run, next(compute))\n"
        "def stall(*_):\n"
        "    print('writing', flush=True); time.sleep(60)\n"
        "writer.write_info = stall\n"
        "t.compute(run, next(compute))\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(REPOSITORY), *sys.path])}
    arguments = [sys.executable, "-c", script, str(root)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, env=environment) as process:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == b"writing"  # in the middle of the second block
        process.send_signal(signal.SIGKILL)
    assert not root.exists()
    run = GenerationRun.open(root, "user/name", make_facts())
    assert [record["attempt"] for record in run.records()] == [0, 1, 2, 3]
    assert len(list((run.directory / "blocks").iterdir())) == 1  # what was half-written is gone
    resumed = list(run.pending_blocks())
    assert resumed == [range(4, 8), range(8, 10)]
    for attempts in resumed:
        compute(run, attempts)
    run.finish()
    generate(tmp_path / "never", make_facts())
    assert files(root) == files(tmp_path / "never")
    assert not partial_directory(root).exists()


def test_resume_with_other_facts_is_refused(tmp_path: Path) -> None:
    GenerationRun.open(tmp_path / "data", "user/name", make_facts())
    GenerationRun.open(tmp_path / "data", "user/name", make_facts())
    with pytest.raises(DatasetError, match=r"seed=0.*seed=1"):
        GenerationRun.open(tmp_path / "data", "user/name", make_facts(seed=1))


@pytest.mark.parametrize("code", ["code_hash", "generator_hash"])
def test_resume_by_other_code_is_refused(tmp_path: Path, code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    GenerationRun.open(tmp_path / "data", "user/name", make_facts()).close()
    monkeypatch.setattr(provenance, code, lambda: "0" * 64)
    with pytest.raises(DatasetError, match="another version of this package"):
        GenerationRun.open(tmp_path / "data", "user/name", make_facts())


def test_root_that_exists_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="exists"):
        GenerationRun.open(tmp_path, "user/name", make_facts())
    assert not partial_directory(tmp_path).exists()


def test_unfinished_run_and_run_without_success_are_refused(tmp_path: Path) -> None:
    run = GenerationRun.open(tmp_path / "data", "user/name", make_facts(num_attempts=1))
    with pytest.raises(DatasetError, match="0 attempts"):
        run.finish()
    write_block(run.directory, run.facts, range(1), [make_episode(0, outcome="ik_failed", length=0)])
    with pytest.raises(DatasetError, match="1 ik_failed"):
        run.finish()
    assert not (tmp_path / "data").exists()


def test_dataset_of_another_version_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="demohlm generate"):
        facts.read_facts(tmp_path)
    generate(tmp_path / "data", make_facts(num_attempts=2))
    path = tmp_path / "data" / facts.FACTS_PATH
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format_version": 99}))
    with pytest.raises(DatasetError, match="version 99"):
        facts.read_facts(tmp_path / "data")
    path.write_text("{")
    with pytest.raises(DatasetError, match="damaged"):
        facts.read_facts(tmp_path / "data")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"outcome": "flew"}, "one of success"),
        ({"state": np.zeros((3, 68), np.float32)}, r"state float32 \(3, 68\)"),
        ({"action": np.full((12, 23), np.nan, np.float32)}, "NaN"),
        ({"success": np.zeros(12)}, "bool"),
    ],
)
def test_invalid_episodes_do_not_travel(changes: dict, message: str) -> None:
    episode = make_episode(0)
    values = {name: getattr(episode, name) for name in episode.__dataclass_fields__}
    with pytest.raises(DatasetError, match=message):
        Episode(**(values | changes))


@pytest.mark.parametrize("targets", [{}, {"num_attempts": 3, "num_episodes": 3}, {"num_attempts": 0}])
def test_one_target_is_needed(targets: dict) -> None:
    with pytest.raises(DatasetError, match="one of the two targets"):
        make_facts(**({"num_attempts": None} | targets))


def test_the_light_modules_import_neither_torch_nor_lerobot() -> None:
    code = (
        "import sys, lerobot_demohlm.datasets.facts, lerobot_demohlm.generation.run\n"
        "assert not {'torch', 'lerobot', 'datasets'} & set(sys.modules), sorted(sys.modules)"
    )
    start = time.monotonic()
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)})
    assert time.monotonic() - start < 60
