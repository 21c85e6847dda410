"""Datasets that ``lerobot-edit-dataset`` makes of ours name their runs: they are verified and explained as before."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset

from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import get_task
from gym_demohlm.scene import build_scene
from lerobot_demohlm import cli
from lerobot_demohlm.checks import verify
from lerobot_demohlm.datasets import origin, reader, writer
from lerobot_demohlm.datasets.facts import GenerationFacts, write_facts
from lerobot_demohlm.datasets.hub import push
from lerobot_demohlm.datasets.in_memory import InMemoryDataset
from lerobot_demohlm.datasets.variation import DataVariation
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.generation.block import write_block
from lerobot_demohlm.generation.run import GenerationRun
from lerobot_demohlm.generation.stages import Settings
from lerobot_demohlm.reports.explain import read_run
from lerobot_demohlm.reproducibility import provenance
from tests.helpers.synthetic import make_episode, make_facts

TASK = get_task("LiftBox")


def generate(root: Path, seed: int, num_attempts: int, noise: float) -> Path:
    """Generate a dataset of which every attempt is an episode, successful or not."""
    demonstration = demonstrations.load(task=TASK)
    facts = GenerationFacts(
        task=TASK.name,
        task_text=TASK.description,
        region="R1",
        seed=seed,
        demonstration_hash=demonstration.content_hash,
        controller_hash=provenance.controller_hash(),
        model_hash=provenance.model_hash(build_scene(TASK).model),
        num_episodes=None,
        num_attempts=num_attempts,
        block_size=8,
        keep_failures=False,
        variation=DataVariation(command_noise=noise),
    )
    settings = Settings(variation=facts.variation)
    attempts = Attempts(TASK, demonstration, "R1", seed, num_worlds=num_attempts, settings=settings)
    run = GenerationRun.open(root, "user/lift", facts)
    for block in run.pending_blocks():
        write_block(run.directory, facts, block, attempts.run(block))
    attempts.close()
    run.finish()
    return root


def edit(*arguments: str) -> None:
    """Run LeRobot's own command, as a user does."""
    words = [str(Path(sys.executable).parent / "lerobot-edit-dataset"), *arguments]
    subprocess.run(words, check=True, capture_output=True, text=True)


def synthetic(root: Path, episodes: int, **changes: object) -> Path:
    """Write a dataset of random episodes that names its origin."""
    facts, made = make_facts(**changes), [make_episode(index) for index in range(episodes)]
    writer.write_dataset(root, "user/data", made, facts)
    write_facts(root, facts, [episode.record() for episode in made])
    return root


def test_an_episode_names_its_origin(tmp_path: Path) -> None:
    root = synthetic(tmp_path / "data", 2, seed=7)
    found = origin.read_origins(root)
    assert list(found) == [0, 1]
    assert found[1].record == make_episode(1).record()
    assert found[0].facts == make_facts(seed=7).content() | {"code_hash": provenance.code_hash()}
    for name in (origin.FACTS_PATH, origin.ATTEMPTS_PATH):
        (root / name).unlink()
    assert origin.is_generated(root) and origin.is_edited(root)
    facts, records = origin.read_run(root)
    assert (facts["seed"], facts["attempts"], records) == (7, 2, [make_episode(i).record() for i in range(2)])
    assert origin.task_of(root) == "LiftBox"
    assert InMemoryDataset("user/data", root=root).is_held
    with pytest.raises(DatasetError, match="push_to_hub"):
        push(root, "user/data")


def test_damaged_and_missing_origins(tmp_path: Path) -> None:
    root = synthetic(tmp_path / "data", 1)
    (root / origin.FACTS_PATH).unlink()
    path = root / writer.episodes_file(0)
    table = pq.read_table(path)
    position = table.schema.get_field_index(origin.COLUMN)
    content = table.column(origin.COLUMN).to_pylist()[0]
    for damage, text in (
        ([*b"{", *content[:-1]], "damaged origin"),
        ([0] * origin.SIZE, "without its origin"),
        ([300] * origin.SIZE, "damaged origin"),
        (list(b'{"facts": {}, "record": {}}'), "the origin of episode 0 without digest"),
        (list(b'{"facts": []}'), "damaged origin"),
    ):
        pq.write_table(table.set_column(position, origin.COLUMN, pa.array([damage])), path)
        with pytest.raises(DatasetError, match=text):
            origin.read_origins(root)
    pq.write_table(table.drop_columns([origin.COLUMN]), path)
    with pytest.raises(DatasetError, match=r"a dataset that `demohlm generate` wrote"):
        origin.read_origins(root)
    assert not origin.is_generated(root)


def test_an_origin_that_is_too_long_is_left_out(tmp_path: Path) -> None:
    columns = origin.columns(make_facts(task_text="x" * origin.SIZE), make_episode(0).record())
    assert columns[origin.COLUMN] == [0] * origin.SIZE


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return datasets of two runs: one whose commands carried noise, one without."""
    folder = tmp_path_factory.mktemp("generated")
    return generate(folder / "noisy", 0, 3, 1.0), generate(folder / "plain", 5, 2, 0.0)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_edited_datasets_are_verified_and_explained(
    generated: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    noisy, plain = generated
    merged, some = tmp_path / "merged", tmp_path / "some"
    of_noisy = ["--repo_id", "user/noisy", "--root", str(noisy)]
    deleting = ["--operation.type", "delete_episodes", "--operation.episode_indices", "[0]"]
    edit(*of_noisy, "--new_repo_id", "user/some", "--new_root", str(some), *deleting)
    splitting = ["--operation.type", "split", "--operation.splits", '{"one": [2], "rest": [0, 1]}']
    edit(*of_noisy, "--new_root", str(tmp_path / "split"), *splitting)
    parts = [tmp_path / "split" / "one", plain]
    merging = ["--operation.type", "merge", "--operation.repo_ids", "['user/one', 'user/plain']"]
    roots = ["--operation.roots", str([str(part) for part in parts])]
    edit("--new_repo_id", "user/merged", "--new_root", str(merged), *merging, *roots)

    expected = {some: [1, 2], tmp_path / "split" / "one": [2], tmp_path / "split" / "rest": [0, 1], merged: [2, 0, 1]}
    for root, attempts in expected.items():
        assert not (root / origin.FACTS_PATH).exists()
        assert [each.record["attempt"] for each in origin.read_origins(root).values()] == attempts
        assert [reader.attempt_of(root, episode) for episode in range(len(attempts))] == attempts
        assert cli.main(["verify", "--root", str(root)]) == 0
        said = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert (said["episodes"], said["identical"], said["mismatches"]) == (len(attempts), True, [])
        LeRobotDataset("user/any", root=root)
        assert InMemoryDataset("user/any", root=root).is_held

    words = ["--episode", "0", "--no-pictures", "--output", str(tmp_path / "page.html")]
    assert cli.main(["explain", "--root", str(merged), *words]) == 0
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (said["attempt"], said["same_bits"]) == (2, True)
    with pytest.raises(DatasetError, match="merged of 2 runs"):
        read_run(merged)
    assert [read_run(merged, episode)[0]["seed"] for episode in range(3)] == [0, 5, 5]
    facts, records = read_run(some)
    assert (facts["seed"], facts["attempts"], [record["attempt"] for record in records]) == (0, 2, [1, 2])

    path = merged / "data/chunk-000/file-000.parquet"  # a bit that is flipped after editing is found, in either kind
    table = pq.read_table(path)
    index = table.schema.get_field_index("observation.state")
    rows = np.array(table.column(index).to_pylist(), dtype=np.float32)
    for row in (4, len(rows) - 4):
        rows[row, 3] = np.nextafter(rows[row, 3], np.float32(9.0))
    pq.write_table(table.set_column(index, table.schema.field(index), [list(rows)]), path)
    first, second = verify.verify(merged, TASK).differences
    assert (first.episode, first.step, first.field) == (0, 4, "observation.state")
    assert "generated again" in first.detail
    assert (second.episode, second.field) == (2, "observation.state")
