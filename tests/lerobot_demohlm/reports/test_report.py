"""The report: one file with everything inside, numbers from the records, nothing from names left unescaped."""

import base64
import io
import json
import re
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gym_demohlm import jsonl
from gym_demohlm.errors import PolicyError
from gym_demohlm.simulation.judge import OUTCOMES
from lerobot_demohlm import cli, quickstart
from lerobot_demohlm.evaluation.rollout import Rollout
from lerobot_demohlm.policies import training
from lerobot_demohlm.reports.films import Film, film_strip, write_video
from lerobot_demohlm.reports.report import render_report


def make_rollouts() -> list[Rollout]:
    return [
        Rollout(
            task="LiftBox",
            region="R1",
            seed=seed,
            policy="chunked_mlp",
            policy_hash="0" * 64,
            num_train_episodes=100,
            success_ever=True,
            success_end=seed != 1,
            success_held=seed > 1,
            outcome="success" if seed > 1 else "dropped",
            length_s=9.5,
            initial_state={"robot": [-0.5 - 0.01 * seed, 0.0, 0.1], "object": [0.0, 0.0, 0.0]},
        )
        for seed in range(10)
    ]


def make_film() -> Film:
    frames = [np.full((48, 64, 3), 20 * index, dtype=np.uint8) for index in range(11)]
    return Film(frames=frames, caption="A <rollout>")


def test_film_strip_shows_first_to_last_frame() -> None:
    strip = np.asarray(Image.open(io.BytesIO(film_strip(make_film(), count=4, width=64))))
    assert strip.shape == (96, 128, 3)
    assert [strip[row, column, 0] for row, column in ((40, 60), (40, 120), (90, 60), (90, 120))] == [0, 60, 140, 200]


def test_page_carries_everything(tmp_path: Path) -> None:
    video = tmp_path / "rollout.mp4"
    write_video(video, make_film())
    facts = {
        "task": "LiftBox",
        "task_text": "Lift <the> box.",
        "region": "R1",
        "seed": 0,
        "attempts": 20,
        "successes": 18,
        "success_rate": 0.9,
        "outcomes": dict.fromkeys(OUTCOMES, 0) | {"success": 18, "ik_failed": 2},
    }
    page = render_report(
        title="LiftBox",
        facts=facts,
        rollouts=make_rollouts(),
        films=[make_film()],
        video=video,
        video_caption="first",
        durations={"Training": 61.0},
    )
    assert "80.0 %" in page  # held
    assert "90.0 %" in page  # at the end, and of the attempts
    assert "49.0 %" in page  # lower end of 8 of 10
    assert "stood for 2 s" not in page  # of a version that did not judge strictly
    assert "too few successes or failures" in page
    assert "94.3 %" in page
    assert "ik failed" in page
    assert "61 s" in page
    assert "A &lt;rollout&gt;" in page
    assert "Lift &lt;the&gt; box." in page
    assert len(re.findall(r"<title>seed \d: success</title>", page)) == 8
    assert len(re.findall(r"<title>seed \d: dropped</title>", page)) == 2
    assert not re.search(r'(src|href)="(?!data:|#)', page)  # nothing is fetched
    embedded = re.search(r"data:video/mp4;base64,([^\"]+)", page)
    assert embedded is not None
    assert base64.b64decode(embedded[1]) == video.read_bytes()
    picture = re.search(r"data:image/png;base64,([^\"]+)", page)
    assert picture is not None
    assert Image.open(io.BytesIO(base64.b64decode(picture[1]))).format == "PNG"


def test_strict_success_comes_first_where_it_was_judged() -> None:
    judged = [replace(rollout, success_strict=rollout.seed > 4) for rollout in make_rollouts()]
    page = render_report(title="LiftBox", rollouts=judged)
    assert '<span class="big">50.0 %</span> of 10 rollouts succeeded' in page
    assert "stood for 2 s" in page
    assert "80.0 %" in page  # held
    again = render_report(title="LiftBox", rollouts=[*judged[:-1], make_rollouts()[-1]])
    assert '<span class="big">80.0 %</span> of 10 rollouts succeeded' in again


def test_a_report_says_in_which_worlds_and_with_which_eyes() -> None:
    plain, first = render_report(title="LiftBox", rollouts=make_rollouts()), make_rollouts()[0]
    assert "worlds that vary" not in plain and "seen by" not in plain
    page = render_report(title="LiftBox", rollouts=[replace(first, variation="hard", perception="rgbd")])
    assert f"{first.region}, in worlds that vary by hard, objects seen by rgbd, seeds" in page


def test_a_report_says_what_success_depended_on() -> None:
    failed = replace(
        make_rollouts()[0], success_strict=False, initial_state={"robot": [0.0, 0.0, 0.0], "object": [0.0] * 3}
    )
    rng = np.random.default_rng(0)
    rollouts = []
    for seed in range(120):
        height = float(rng.uniform(-0.2, 0.2))
        state = {"robot": rng.uniform(-1.0, 1.0, 3).tolist(), "object": [0.0, height, 0.0]}
        rollouts.append(replace(failed, seed=seed, success_strict=height < 0.1, initial_state=state))
    page = render_report(title="LiftBox", rollouts=rollouts)
    assert re.search(r"<tr><td>object dz \[m\]</td><td[^>]*>100 % .*below 0.0001</td></tr>", page)


def test_quickstart_refuses_before_it_works(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["--root", str(tmp_path)], ["--task", "LiftBx"], ["--region", "R8"], ["--steps", "0"]):
        root = [] if "--root" in arguments else ["--root", str(tmp_path / "new")]
        assert cli.main(["quickstart", *root, *arguments]) == 2
        assert capsys.readouterr().err.count("error: ") == 1
    assert not (tmp_path / "new").exists()
    with pytest.raises(PolicyError, match="num_rollouts=0"):
        quickstart.Quickstart(root=tmp_path, num_rollouts=0)


@pytest.mark.slow
def test_training_of_the_quickstart(tmp_path: Path) -> None:
    from lerobot_demohlm.datasets import writer
    from lerobot_demohlm.evaluation.loaded_policy import load_policy
    from tests.helpers.synthetic import make_episode

    writer.write_dataset(tmp_path / "data", "local/data", [make_episode(index) for index in range(3)])
    checkpoint = training.train(tmp_path / "train", tmp_path / "data", steps=2, seed=0)
    loaded = load_policy(checkpoint, "LiftBox")
    assert (loaded.kind, loaded.num_train_episodes) == ("chunked_mlp", 3)
    saved = json.loads((checkpoint / "train_config.json").read_text())
    assert (saved["batch_size"], saved["steps"]) == (512, 2)


@pytest.mark.slow
def test_the_quickstart_scores_two_regions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = tmp_path / "quick"
    counts = ["--num-episodes", "2", "--steps", "2", "--num-rollouts", "1", "--num-workers", "1"]
    assert cli.main(["quickstart", "--root", str(root), *counts]) in (None, 0)
    said = capsys.readouterr()
    assert "Success in R1, the region of the data: " in said.err
    assert "Success in R3, the paper's widest region, without data of it: " in said.err
    assert said.out.splitlines()[-1] == str(root / "report.html")
    saved = json.loads((root / "train/checkpoints/last/pretrained_model/train_config.json").read_text())
    assert (saved["batch_size"], saved["num_workers"]) == (quickstart.BATCH_SIZE, 0)
    assert saved["policy"]["hidden_dims"] == quickstart.NETWORK["hidden_dims"]
    for name, region in (("rollouts.jsonl", "R1"), ("rollouts_R3.jsonl", "R3")):
        (line,) = [json.loads(text) for text in (root / name).read_text().splitlines()]
        assert line["region"] == region


def test_a_report_of_two_tasks_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = make_rollouts()[0]
    other = "GraspCube" if first.task != "GraspCube" else "LiftBox"
    jsonl.append(tmp_path / "rollouts.jsonl", map(asdict, [first, replace(first, task=other)]))
    call = ["report", "--evaluation", str(tmp_path / "rollouts.jsonl"), "--output", str(tmp_path / "report.html")]
    assert cli.main(call) == 2
    assert "of one task" in capsys.readouterr().err and not (tmp_path / "report.html").exists()


@pytest.mark.parametrize(
    ("options", "got"),
    [
        (["--results", "results", "--root", "nowhere", "--video", "none.mp4"], "--root and --video with --results"),
        (["--evaluation", "nowhere.jsonl", "--num-videos", "2"], "--num-videos without --results"),
    ],
)
def test_options_of_the_other_report_are_refused(
    options: list[str], got: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["report", *options, "--output", str(tmp_path / "report.html")]) == 2
    assert got in capsys.readouterr().err and not (tmp_path / "report.html").exists()
