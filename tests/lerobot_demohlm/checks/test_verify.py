"""Verification: a dataset as generated agrees in every bit; whatever bit is flipped in it is found, and its place."""

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from gym_demohlm.control import controllers
from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import get_task
from gym_demohlm.scene import build_scene
from lerobot_demohlm import cli
from lerobot_demohlm.checks import verify
from lerobot_demohlm.datasets import facts, origin, reader
from lerobot_demohlm.generation.block import write_block
from lerobot_demohlm.generation.request import GenerationRequest
from lerobot_demohlm.generation.run import GenerationRun, failures_root
from lerobot_demohlm.generation.runner import generate
from lerobot_demohlm.reproducibility import fingerprint, provenance
from tests.helpers import small_run as run
from tests.helpers.synthetic import make_episode, make_facts

DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
STEP = 20  # that is tampered with; verification ends there


@pytest.fixture
def copy(small_run: Path, tmp_path: Path) -> Path:
    """Return a copy of the dataset that a test may damage."""
    return shutil.copytree(small_run, tmp_path / "copy")


def flip(root: Path, path: str, column: str, change: Callable[[list[Any]], None]) -> None:
    """Change the values of a column, as Python lists."""
    table = pq.read_table(root / path)
    values = table.column(column).to_pylist()
    change(values)
    index = table.schema.get_field_index(column)
    pq.write_table(
        table.set_column(index, table.schema.field(index), pa.array(values, table.schema.field(index).type)),
        root / path,
    )


def flip_last_bit(number: float) -> float:
    """Return the float32 whose last bit is the other one."""
    return float((np.float32(number).view(np.uint32) ^ np.uint32(1)).view(np.float32))


def edit_record(root: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change the line of the attempt that the dataset's episode is."""
    records = facts.read_attempts(root)
    change(records[run.SUCCEEDED[0]])
    (root / facts.ATTEMPTS_PATH).write_text("".join(json.dumps(record) + "\n" for record in records))


def test_a_dataset_agrees_in_every_bit(small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for part in ("data", "meta"):  # what LeRobot pulls from the hub
        shutil.copytree(small_run / part, tmp_path / part)
    assert cli.main(["verify", "--root", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    frames = facts.read_attempts(small_run)[0]["frames"]
    assert lines[0].startswith(f"1 episodes, {frames} steps: every bit as generated")
    said = json.loads(lines[-1])
    assert (said["identical"], said["steps"], said["mismatches"], said["differences"]) == (True, frames, [], [])


def test_failed_attempts_agree_too_and_batches_do_not_matter(small_run: Path) -> None:
    outcome = verify.verify(failures_root(small_run), run.TASK)
    assert outcome.identical
    assert outcome.episodes == len(run.FAILED)


def test_failed_attempts_of_a_run_with_pictures_have_none_to_compare(small_run: Path, tmp_path: Path) -> None:
    root = shutil.copytree(failures_root(small_run), tmp_path / "failures")
    path = root / "meta" / "demohlm.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"pictures": {"cameras": ["head:96x96:rgb"]}}))
    assert verify.verify(root, run.TASK, [0]).identical


@pytest.mark.parametrize("column", ["action", "observation.state", "observation.environment_state"])
def test_a_flipped_bit_in_the_data_is_found(copy: Path, column: str) -> None:
    def change(rows: list[list[float]]) -> None:
        rows[STEP][3] = flip_last_bit(rows[STEP][3])

    flip(copy, DATA, column, change)
    (difference,) = verify.verify(copy, run.TASK).differences
    assert (difference.episode, difference.attempt, difference.step) == (0, run.SUCCEEDED[0], STEP)
    assert difference.field == column
    names = {"observation.state": "left_knee.pos", "observation.environment_state": "box_r11.pos"}
    assert difference.detail.startswith(names.get(column, "by its fingerprint"))


def test_a_flipped_success_flag_is_found(copy: Path) -> None:
    def change(rows: list[bool]) -> None:
        rows[STEP] = not rows[STEP]

    flip(copy, DATA, "next.success", change)
    (difference,) = verify.verify(copy, run.TASK).differences
    assert (difference.step, difference.field, difference.detail) == (
        STEP, "next.success", "success: True stored, False simulated",
    )  # fmt: skip


def test_an_action_that_is_no_number_is_found(copy: Path) -> None:
    def change(rows: list[list[float]]) -> None:
        rows[STEP][0] = float("nan")

    flip(copy, DATA, "action", change)
    (difference,) = verify.verify(copy, run.TASK).differences
    assert (difference.step, difference.field, difference.detail) == (
        STEP, "action", "base_x.vel is not a finite number",
    )  # fmt: skip


@pytest.mark.parametrize("field", ["physics", "controller", "contacts"])
def test_another_simulation_is_found_by_its_fingerprint(
    copy: Path, field: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def change(rows: list[bytes]) -> None:
        trail = fingerprint.from_bytes(rows[0]).copy()
        trail[STEP + 1, fingerprint.FIELDS.index(field)] ^= 1
        rows[0] = trail.tobytes()

    flip(copy, EPISODES, "fingerprints", change)
    assert cli.main(["verify", "--root", str(copy), "--episodes", "0"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"episode 0 (attempt 0) differs at step {STEP}: {field}, by its fingerprint"
    said = json.loads(lines[-1])
    assert not said["identical"]
    assert said["differences"][0] | {"detail": ""} == {
        "episode": 0, "attempt": 0, "step": STEP, "field": field, "detail": "", "deviation": None,
    }  # fmt: skip


def test_another_start_is_found(copy: Path) -> None:
    def change(record: dict[str, Any]) -> None:
        record["initial_state"]["object"][1] = float(np.nextafter(record["initial_state"]["object"][1], 1.0))

    edit_record(copy, change)
    (difference,) = verify.verify(copy, run.TASK).differences
    assert (difference.step, difference.field) == (0, "start")


def test_the_digest_counts_beside_the_fingerprints(copy: Path) -> None:
    edit_record(copy, lambda record: record.update(digest=record["digest"][::-1]))
    (difference,) = verify.verify(copy, run.TASK).differences
    assert difference.field == "digest"


def say_other_versions(root: Path) -> None:
    """Let a dataset be of another version of MuJoCo, with another model, and older than the record of eigenpy."""
    kept = json.loads((root / facts.FACTS_PATH).read_text())
    kept["model_hash"] = "0" * 64
    kept["versions"]["mujoco"] = "2.0"
    del kept["versions"]["eigenpy"]
    (root / facts.FACTS_PATH).write_text(json.dumps(kept))


def test_another_installation_is_a_remark_where_bits_agree(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    say_other_versions(copy)
    assert cli.main(["verify", "--root", str(copy)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"model {'0' * 20} when generated, ")
    assert lines[1].startswith("mujoco 2.0 when generated, ")
    assert lines[2].startswith("eigenpy unknown when generated, ")
    assert "every bit as generated" in lines[4]
    said = json.loads(lines[-1])
    assert (said["identical"], len(said["mismatches"]), len(said["other_versions"])) == (True, 3, 2)


def test_a_dataset_of_another_controller_is_verified_with_it(tmp_path: Path) -> None:
    other = next(controller for controller in controllers.installed() if not controller.is_default)
    request = GenerationRequest(
        task="LiftBox", region="R1", seed=1, root=tmp_path / "data", num_attempts=1, controller=other.name, block_size=1
    )
    assert generate(request).successes == 1
    found = facts.read_facts(request.root)
    assert found["controller_hash"] == other.hash
    assert found["model_hash"] != provenance.model_hash(build_scene(get_task("LiftBox")).model)  # another physics
    task = get_task("LiftBox")
    outcome = verify.verify(request.root, task)
    assert outcome.identical
    assert outcome.mismatches == ()
    wrong = verify.verify(request.root, task, controller=controllers.DEFAULT)
    assert not wrong.agrees
    assert [line.split()[0] for line in wrong.mismatches] == ["controller", "model"]


@pytest.mark.parametrize(("change_by", "code"), [(0.02, 0), (0.5, 1)])
def test_under_other_versions_episodes_agree_within_bounds(
    copy: Path, change_by: float, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    def change(rows: list[list[float]]) -> None:
        for row in rows[STEP : STEP + 5]:
            row[7] += change_by  # a joint of the left arm [rad]

    flip(copy, DATA, "action", change)
    assert not verify.verify(copy, run.TASK).agrees  # equal versions: no bit may differ
    say_other_versions(copy)
    assert cli.main(["verify", "--root", str(copy)]) == code
    lines = capsys.readouterr().out.splitlines()
    said = json.loads(lines[-1])
    assert not said["identical"]
    assert said["episodes_within_bounds"] == 1 - code
    deviation = said["differences"][0]["deviation"]
    assert (deviation["joints"] > verify.BOUNDS.joints) == bool(code)
    assert f"0 agree in every bit, {1 - code} more within the bounds" in lines[-2]
    assert ("differs at step" in lines[-3]) == bool(code)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--episodes", "7"], "episode 7"),
        (["--episodes", "one"], "--episodes one"),
        (["--sample", "0"], "--sample 0"),
        (["--num-workers", "0"], "num_workers=0"),
        (["--task", "PushCube"], "a dataset of LiftBox"),
    ],
)
def test_wrong_requests(small_run: Path, arguments: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["verify", "--root", str(small_run), *arguments]) == 2
    assert text in capsys.readouterr().err


def test_datasets_that_cannot_be_verified(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["verify", "--root", str(copy / "nowhere")]) == 2
    table = pq.read_table(copy / EPISODES)
    pq.write_table(table.drop_columns(["fingerprints", origin.COLUMN]), copy / EPISODES)
    assert cli.main(["verify", "--root", str(copy)]) == 2
    (copy / facts.FACTS_PATH).unlink()
    assert cli.main(["verify", "--root", str(copy)]) == 2
    first, second, third = capsys.readouterr().err.splitlines()
    assert "without meta/demohlm.json" in first
    assert "without fingerprints" in second and "generate it again" in second
    assert "a dataset that `demohlm generate` wrote" in third


def test_damaged_files_are_errors(copy: Path) -> None:
    (copy / DATA).write_bytes((copy / DATA).read_bytes()[:500])
    with pytest.raises(DatasetError, match="cannot be read"):
        reader.read(copy, [0])
    (copy / facts.ATTEMPTS_PATH).write_text('{"attempt": 0, "outcome": "success", "frames": 3}\n')
    with pytest.raises(DatasetError, match="digest"):
        facts.read_attempts(copy)


@pytest.mark.parametrize(("fact", "value"), [
    ("task", "stranger:LiftBox"), ("retries", "x"), ("pictures", "abc"), ("versions", {"cpu": 5}),
])  # fmt: skip
def test_facts_that_cannot_be_are_refused_and_nothing_is_imported(
    copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fact: str, value: object
) -> None:
    (tmp_path / "stranger.py").write_text("raise AssertionError('a file had this module imported')")
    monkeypatch.syspath_prepend(tmp_path)
    kept = json.loads((copy / facts.FACTS_PATH).read_text())
    (copy / facts.FACTS_PATH).write_text(json.dumps(kept | {fact: value}))
    with pytest.raises(DatasetError, match="damaged"):
        origin.task_of(copy)
    assert cli.main(["verify", "--root", str(copy)]) == 2
    assert "stranger" not in sys.modules


@pytest.mark.parametrize("start", [{"robot": 5}, {"robot": ["x"]}, {"objects.mass.box": {}}])
def test_starts_that_are_no_numbers_are_refused(copy: Path, start: dict[str, object]) -> None:
    edit_record(copy, lambda record: record["initial_state"].update(start))
    with pytest.raises(DatasetError, match="initial_state"):
        facts.read_attempts(copy)


def test_choosing_episodes() -> None:
    assert verify.choose("all", None, 4, 0) == [0, 1, 2, 3]
    assert verify.choose("3,1", None, 4, 0) == [3, 1]
    drawn = verify.choose("all", 5, 100, 0)
    assert drawn == sorted(set(drawn)) == verify.choose("all", 5, 100, 0)
    assert len(drawn) == 5
    assert drawn != verify.choose("all", 5, 100, 1)


def test_failed_attempts_are_a_labelled_dataset(small_run: Path) -> None:
    from lerobot.datasets import LeRobotDataset

    opened = LeRobotDataset("user/small", root=failures_root(small_run))
    records = [facts.read_attempts(small_run)[attempt] for attempt in run.FAILED]
    for key in ("attempt", "outcome", "stage"):
        assert opened.meta.episodes[key] == [record[key] for record in records]
    assert opened.meta.filter_episodes(lambda episode: episode["outcome"] == "timeout") == [0, 1]
    assert opened.meta.filter_episodes(lambda episode: episode["attempt"] == run.FAILED[1]) == [1]
    assert opened[0]["action"].shape == (23,)
    card = (failures_root(small_run) / "README.md").read_text()
    assert "failed attempts" in card and "met the task's success condition" not in card
    assert "met the task's success condition" in (small_run / "README.md").read_text()


def test_failures_without_a_frame_are_counted(tmp_path: Path) -> None:
    episodes = [
        make_episode(0),
        make_episode(1, outcome="off_course", length=0),
        make_episode(2, outcome="dropped"),
    ]
    kept = make_facts(num_attempts=3, keep_failures=True)
    generation = GenerationRun.open(tmp_path / "data", "user/name", kept)
    write_block(generation.directory, kept, range(3), episodes)
    content = generation.finish()
    assert (content["outcomes"]["off_course"], content["outcomes"]["dropped"]) == (1, 1)
    assert reader.lengths(failures_root(tmp_path / "data")) == {0: 12}
    records = facts.read_attempts(failures_root(tmp_path / "data"))
    assert [record["frames"] for record in records] == [12, 0, 12]


@pytest.mark.slow
def test_workers_find_the_same(small_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = shutil.copytree(failures_root(small_run), tmp_path / "failures")
    monkeypatch.setattr(verify, "NUM_WORLDS", 1)  # a batch for each of two workers

    def change(rows: list[list[float]]) -> None:
        for row in (rows[STEP], rows[reader.lengths(root)[0] + STEP]):
            row[3] = flip_last_bit(row[3])

    flip(root, DATA, "observation.state", change)
    found = verify.verify(root, run.TASK, num_workers=2)
    assert [difference.episode for difference in found.differences] == [0, 1]
    assert found == verify.verify(root, run.TASK)
