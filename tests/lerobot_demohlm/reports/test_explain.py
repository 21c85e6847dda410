"""Explanations: an attempt made again has the bits of the run, and pages say the numbers that are there."""

import dataclasses
import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.errors import DatasetError
from gym_demohlm.scene import build_scene
from lerobot_demohlm import cli
from lerobot_demohlm.datasets import facts
from lerobot_demohlm.datasets.variation import PLAIN, DataVariation
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.generation import stages
from lerobot_demohlm.generation.block import write_block
from lerobot_demohlm.generation.run import GenerationRun
from lerobot_demohlm.reports import explain
from lerobot_demohlm.reports.explain import figures, run_page, story
from lerobot_demohlm.reports.explain.attempt_page import attempt_page, film_strips, footprint, plan
from lerobot_demohlm.reports.explain.trace import Trace, trace
from lerobot_demohlm.reports.films import CAMERAS
from tests.helpers import small_run as run
from tests.helpers.synthetic import make_episode, make_facts

FAILED = run.FAILED[0]
SETTINGS = stages.Settings(variation=PLAIN)  # of the small run


@pytest.fixture(scope="module")
def success() -> Trace:
    return trace(run.TASK, demonstrations.load(task=run.TASK), run.REGION, run.SEED, run.SUCCEEDED[0], SETTINGS)


@pytest.fixture(scope="module")
def failure() -> Trace:
    return trace(run.TASK, demonstrations.load(task=run.TASK), run.REGION, run.SEED, FAILED, SETTINGS)


def test_a_trace_is_the_attempt_of_the_run(small_run: Path, success: Trace, failure: Trace) -> None:
    records = facts.read_attempts(small_run)
    for made, record in ((success, records[run.SUCCEEDED[0]]), (failure, records[FAILED])):
        assert made.episode.record() == record
        assert len(made.snapshots) == len(made) + 1 == record["frames"] + 1
        lengths: dict[str, float] = {}
        for stage, start, stop in made.bands():
            lengths[stage] = lengths.get(stage, 0.0) + stop - start
        assert lengths == pytest.approx(record["stage_s"])


def test_what_a_trace_holds_fits_together(success: Trace) -> None:
    walking = np.array(success.stages) == stages.LOCOMOTION
    assert np.isnan(success.targets[walking]).all()
    assert np.isfinite(success.targets[~walking]).all()
    assert (success.ticks[walking] == -1).all()
    assert (np.diff(success.ticks[~walking]) >= 0).all()
    assert success.ticks[-1] == len(success.demonstration) - 1
    assert set(success.activities) == {"walk", "follow", "wait", "hold"}
    assert success.placement is not None
    missed = poses.to_planar(success.pelvis[int(walking.sum())])[:2] - success.placement.goal[:2]
    assert np.linalg.norm(missed) < stages.Settings().locomotion.accept_m
    first, second = success.started
    assert (first.group[0].kind, second.group[0].kind) == ("object", "proprioception")
    assert success.started_at[0] == int(walking.sum())
    T_world_box = success.objects[success.started_at[0], 0] @ success.placement.symmetry
    np.testing.assert_array_equal(first.frames_now[0], T_world_box)
    force = success.contact_forces.reshape(len(success), 5, -1)[-1, -1]
    np.testing.assert_array_equal(force, success.snapshots[-1]["forces"][0, : force.shape[0]])
    assert np.nanmax(success.hand_errors()) < 0.15


def test_velocity_is_that_of_the_base_in_its_heading(success: Trace) -> None:
    steps = 40
    t = 0.1 * np.arange(steps + 1)
    circle = poses.planar(np.sin(0.5 * t), 1.0 - np.cos(0.5 * t), 0.5 * t)  # 0.5 m/s forward, turning left
    episode = dataclasses.replace(
        success.episode,
        fingerprints=success.episode.fingerprints[: steps + 1],
        **{
            name: getattr(success.episode, name)[:steps] for name in ("state", "environment_state", "action", "success")
        },
        outcome="timeout",
    )
    velocity = dataclasses.replace(success, pelvis=circle, episode=episode).base_velocity(7)
    np.testing.assert_allclose(velocity[5:-5], np.tile([0.5, 0.0, 0.5], (steps - 10, 1)), atol=0.02)


def test_an_attempt_in_a_varied_world_is_drawn_as_it_was() -> None:
    settings = stages.Settings(variation=DataVariation(variation="real"))
    made = trace(run.TASK, demonstrations.load(task=run.TASK), "R4", run.SEED, 0, settings)
    strips = film_strips(dataclasses.replace(made, snapshots=made.snapshots[::60]))
    assert [strip["caption"] for strip in strips] == list(CAMERAS.values())
    world, plain = made.take().world(), build_scene(made.task, variation=made.variation).model
    world.mj_data()
    (ratio,) = made.episode.initial_state["objects.size.box"]
    assert ratio != 1.0
    np.testing.assert_allclose(footprint(world.model, "box"), footprint(plain, "box") * ratio)
    world.close()
    assert "<svg" in plan(made)


def test_the_page_of_a_success(success: Trace) -> None:
    page = attempt_page(success, origin="a run", again="every bit", pictures=False)
    episode = success.episode
    assert f"<b>Success</b> in manipulation after {episode.length_s:.1f} s" in page
    for number in (*episode.initial_state["robot"][:2], *episode.initial_state["object"][:2]):
        assert f"{number:.3f} m" in page
    assert f"{math.degrees(episode.initial_state['object'][2]):.1f} deg" in page
    assert success.placement is not None
    assert story.planar_words(success.placement.goal) in page
    for stage, ticks in episode.stage_ticks.items():
        assert re.search(rf"{stage.replace('_', ' ')}\s+{ticks / 10:.1f} s", page)
    for begun in success.started:
        assert story.pose_words(begun.frames_now[0]) in page
    for title in ("left hand on box [N]", "torso height [m]", "yaw rate [rad/s]", "palms from their targets [mm]"):
        assert title in page
    first = int(np.flatnonzero(episode.success)[0]) + 1
    assert f"{first / 10:.1f} s" in page and "the success condition holds for the first time" in page
    assert all(place[0] == "#" for place in re.findall(r'(?:src|href)="([^"]*)"', page)), "nothing is fetched"
    assert "left hand follows" in page, "the demonstration's timeline"
    assert set(re.findall(r"https?://[^\"' ]+", page)) == {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}


def test_the_page_of_a_failure_says_what_ended_it(failure: Trace) -> None:
    page = attempt_page(failure, origin="a run", again="", pictures=False)
    assert f"<b>Timeout</b> in manipulation after {failure.episode.length_s:.1f} s" in page
    assert "The motion was over and the success condition never held." in page
    assert "timeout: the motion was over and the success condition never held" in page
    assert "holds for the first time" not in page


def test_tracking_is_measured_less_commanded(success: Trace) -> None:
    rows = {name: values for name, _, values in story.tracking_table(success)}
    steps = np.array(success.stages) == stages.MANIPULATION
    error = success.pelvis[1:, 2, 3][steps] - success.episode.action[steps, 3]
    assert rows["torso height"]["manipulation"] == pytest.approx(1000 * np.sqrt(np.mean(error**2)), rel=1e-6)
    assert math.isnan(rows["left palm from its target"]["locomotion"])


def test_an_attempt_from_the_command_line(small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "pages" / "attempt.html"
    command = ["explain", "--root", str(small_run), "--episode", "0", "--output", str(output)]
    assert cli.main(command) == 0
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (said["outcome"], said["same_bits"], said["page"]) == ("success", True, str(output))
    page = output.read_text()
    assert "Made again for this page: every bit as in the run." in page
    assert page.count('src="data:image/jpeg;base64,') == 2
    assert cli.main(command) == 2
    assert "which exists" in capsys.readouterr().err


def test_the_page_of_a_run(small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "run.html"
    assert cli.main(["explain", "--root", str(small_run), "--output", str(output)]) == 0
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (said["attempts"], said["successes"], said["outcomes"]["timeout"]) == (3, 1, 2)
    page = output.read_text()
    assert '<span class="big">33.3 %</span> of 3 attempts succeeded' in page
    for record in facts.read_attempts(small_run):
        assert run_page.command_line(small_run, record["attempt"]) in page
        if record["outcome"] != "success":
            assert f"attempt {record['attempt']}: timeout in manipulation, {record['reason']}" in page


def records_of(outcomes: list[str]) -> list[dict]:
    rng = np.random.default_rng(0)
    return [
        {
            "attempt": index,
            "outcome": outcome,
            "stage": "locomotion" if outcome == "fell" else "manipulation",
            "reason": f"the left palm is {index / 10:.2f} m away (at most 0.1 m)" if outcome == "ik_failed" else "",
            "length_s": 5.0 + index,
            "stage_s": {"locomotion": 5.0} | ({} if outcome == "fell" else {"manipulation": float(index)}),
            "initial_state": run.TASK.sample("R1", rng),
        }
        for index, outcome in enumerate(outcomes)
    ]


def test_a_run_that_never_succeeds_is_explained_from_what_it_has_done(tmp_path: Path) -> None:
    kept = make_facts(num_attempts=3, block_size=2)
    with_blocks = GenerationRun.open(tmp_path / "data", "user/name", kept)
    for block in with_blocks.pending_blocks():
        write_block(with_blocks.directory, kept, block, [make_episode(index, outcome="dropped") for index in block])
    with pytest.raises(DatasetError, match=f"demohlm explain --root {with_blocks.directory}"):
        with_blocks.finish()
    page = explain.explain_run(with_blocks.directory)
    assert '<span class="big">0.0 %</span> of 3 attempts succeeded' in page
    shutil.rmtree(with_blocks.directory / "blocks")
    with pytest.raises(DatasetError, match="without a finished block"):
        explain.explain_run(with_blocks.directory)


def test_counts_of_a_run() -> None:
    records = records_of(["success", "fell", "ik_failed", "ik_failed", "success"])
    assert run_page.ends(records) == [
        ("success", {"locomotion": 0, "pre_manipulation": 0, "manipulation": 2}, 2),
        ("ik_failed", {"locomotion": 0, "pre_manipulation": 0, "manipulation": 2}, 2),
        ("fell", {"locomotion": 1, "pre_manipulation": 0, "manipulation": 0}, 1),
    ]
    assert run_page.reasons(records[1:4])[0] == ("ik_failed", "the left palm is … m away", 2, [2, 3])
    locomotion, manipulation = run_page.stage_times(records)
    assert locomotion == ("locomotion", 5, 5.0, 5.0, 5.0)
    assert manipulation[:3] == ("manipulation", 4, pytest.approx((0 + 2 + 3 + 4) / 4))


def test_maps_count_every_attempt_once_where_it_began() -> None:
    records = records_of(["success", "fell"] * 60)
    success = np.array([record["outcome"] == "success" for record in records])
    for figure in run_page.maps(records, success, run.TASK.region("R1")):
        cells = re.findall(r"<title>(\d+) of (\d+) attempts succeeded</title>", figure)
        assert sum(int(good) for good, _ in cells) == 60
        assert sum(int(count) for _, count in cells) == 120
        assert len(re.findall(r"<title>attempt \d+: fell", figure)) == 60
    axis = figures.Axis(name="x", values=np.array([-0.6, -0.46, -0.3]), low=-0.6, high=-0.3)
    assert axis.bins(3).tolist() == [0, 1, 2]
    assert len(run_page.bars(records, success, run.TASK.region("R1"))) == 6


def test_curves_have_gaps_where_nothing_is_known() -> None:
    values = np.array([0.0, 1.0, np.nan, 0.5, 1.0])
    (curve,) = [figures.Curve(name="known", values=values, colour="#123456")]
    drawn = figures.chart("of something [m]", [curve], 4.0, [(0.0, 4.0, "#e3edf7")], {"success": 3.9})
    paths = re.findall(r'<path d="([^"]*)"[^>]*#123456', drawn)
    assert sorted(path.count("M") for path in paths) == [1, 2], "the legend's line, and the curve in two pieces"
    for words in ("of something [m]", "known", "success", "2 s"):
        assert f">{words}</text>" in drawn
    assert drawn == figures.chart("of something [m]", [curve], 4.0, [(0.0, 4.0, "#e3edf7")], {"success": 3.9})


def test_wrong_requests(small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def error_of(*arguments: str, root: Path = small_run) -> str:
        assert cli.main(["explain", "--root", str(root), "--output", str(tmp_path / "page.html"), *arguments]) == 2
        assert not (tmp_path / "page.html").exists()
        return capsys.readouterr().err

    assert "attempt 3" in error_of("--attempt", "3")
    assert "episode 1" in error_of("--episode", "1")
    assert "without meta/demohlm.json" in error_of(root=tmp_path)
    assert "a demonstration" in error_of("--attempt", "0", "--demonstration", str(tmp_path))
    copy = shutil.copytree(small_run, tmp_path / "copy")
    kept = json.loads((copy / facts.FACTS_PATH).read_text())
    (copy / facts.FACTS_PATH).write_text(json.dumps(kept | {"demonstration_hash": "0" * 64}))
    assert "000000000000, which the run was made from" in error_of("--attempt", "0", root=copy)


def test_another_digest_is_said(failure: Trace) -> None:
    record = failure.episode.record()
    assert explain.agreement(record, failure.episode).endswith("every bit as in the run.")
    assert "`demohlm verify` says what differs" in explain.agreement(record | {"digest": "0"}, failure.episode)
