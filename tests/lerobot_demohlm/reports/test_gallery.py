"""The gallery: what it draws is the episode of that seed and index, and its pages show what was written, no more."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gym_demohlm.envs.rendering import Renderer
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from lerobot_demohlm import cli
from lerobot_demohlm.datasets.variation import DataVariation
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.evaluation.loaded_policy import load_policy
from lerobot_demohlm.evaluation.rollouts import Setting, rollouts
from lerobot_demohlm.generation.attempt import attempt
from lerobot_demohlm.generation.stages import Settings
from lerobot_demohlm.reports import films, gallery
from lerobot_demohlm.reports.films import Shots, Take
from tests.helpers.checkpoints import save_policy

TASK = get_task("LiftBox")


@pytest.fixture(scope="module")
def take() -> Take:
    return films.generated_take(TASK, "R1", seed=7, index=1)


def test_a_take_is_the_attempt_of_that_seed_and_index(take: Take) -> None:
    episode = attempt(TASK, demonstrations.load(task=TASK), "R1", 7, 1)
    assert (take.outcome, take.length_s) == (episode.outcome, episode.length_s)
    assert len(take.snapshots) == len(episode.action) + 1
    sim = Simulation(TASK)
    verdicts = []
    for snapshot in take.snapshots[1:]:
        sim.restore(snapshot)
        verdicts.append(bool(sim.success()[0]))
    sim.close()
    assert verdicts == episode.success.tolist()
    assert f"R1, seed 7, attempt 1: success after {episode.length_s:.1f} s" == take.caption


def test_a_take_is_drawn_in_the_world_that_it_had(tmp_path: Path) -> None:
    task, settings = get_task("PressCube"), Settings(variation=DataVariation(variation="real"))
    take = films.generated_take(task, "R4", seed=970001, index=0, variation="real")
    episode = attempt(task, demonstrations.load(task=task), "R4", 970001, 0, settings)
    assert (take.outcome, take.length_s) == (episode.outcome, episode.length_s)
    assert take.initial_state == episode.initial_state
    assert take.caption.startswith("R4 under real, seed 970001, attempt 0: ")
    world, plain = take.world(), Simulation(take.task, variation=take.variation)
    sizes = []
    for sim in (world, plain):
        sim.restore(take.snapshots[-1])
        sim.mj_data()
        sizes.append(sim.model.geom("cube").size[0])
        sim.close()
    (ratio,) = take.initial_state["objects.size.cube"]
    assert ratio != 1.0
    assert sizes[0] / sizes[1] == pytest.approx(ratio)
    films.write_take(dataclasses.replace(take, snapshots=take.snapshots[::40]), tmp_path, width=64, videos=False)
    assert {path.name for path in tmp_path.iterdir()} == {f"press_cube_{camera}.png" for camera in films.CAMERAS}


def test_a_policy_is_filmed_in_the_worlds_that_it_is_asked_for(tmp_path: Path) -> None:
    policy = save_policy(tmp_path / "policy")
    setting = Setting(task="LiftBox", region="R1", num_worlds=1, variation="real:objects")
    take = films.policy_take(TASK, "R1", 5, policy, "real:objects")
    (rollout,) = rollouts(load_policy(policy, "LiftBox"), setting, [5])
    assert (take.outcome, take.initial_state) == (rollout.outcome, rollout.initial_state)
    assert "objects.mass.box" in take.initial_state
    assert "R1 under real:objects, seed 5" in take.caption


def test_shots_show_the_moment_that_is_asked_for(take: Take) -> None:
    sim = Simulation(TASK)
    with Renderer(sim.model, 96, 72) as renderer:
        shots = Shots(take, sim, "overview", renderer)
        last = shots[len(shots) - 1]
        first = shots[0]
        assert np.array_equal(shots[len(shots) - 1], last)
        assert not np.array_equal(first, last)
        sim.restore(take.snapshots[0])
        assert np.array_equal(renderer.render(sim.mj_data(), "overview"), first)
    sim.close()


def test_films_and_pages(take: Take, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(films, "SHADOW_SIZE", 256)  # a fraction of the work
    short = dataclasses.replace(take, snapshots=take.snapshots[::30], outcome="ik_failed")
    films.write_take(short, tmp_path / "films", width=64)
    names = {f"lift_box_{camera}.{kind}" for camera in films.CAMERAS for kind in ("png", "mp4")}
    assert {path.name for path in (tmp_path / "films").iterdir()} == names
    with Image.open(tmp_path / "films" / "lift_box_head.png") as strip:
        rows = 2 if len(short.snapshots) > 3 else 1
        assert strip.height == 48 * rows
        assert strip.width % 64 == 0
    films.write_take(short, tmp_path / "one", width=64, strips=False, cameras=("head",))
    assert [path.name for path in (tmp_path / "one").iterdir()] == ["lift_box_head.mp4"]
    page = gallery.render_page([short], "gallery.html.j2", ".", videos=True)
    assert set(re.findall(r'src="\./([^"]+)"', page)) == names
    assert TASK.description in page and "ik failed after" in page and 'class="small failed"' in page
    assert "<video" not in gallery.render_page([short], "gallery.html.j2", ".", videos=False)
    markdown = tmp_path / "docs" / "gallery.md"
    gallery.write_markdown([short], tmp_path / "films", markdown)
    linked = re.findall(r"\]\(([^)]+)\)", markdown.read_text())
    assert linked == ["gallery/lift_box_overview.png", "gallery/lift_box_head.png"]
    assert all((markdown.parent / link).is_file() for link in linked)
    beside = tmp_path / "films.md"  # its folder is that of the films
    gallery.write_markdown([short], tmp_path / "films", beside)
    assert re.findall(r"\]\(films/([^)]+)\)", beside.read_text()) == ["lift_box_overview.png", "lift_box_head.png"]
    assert {path.name for path in (tmp_path / "films").iterdir()} == names


@pytest.mark.parametrize(
    "arguments",
    [
        ["--task", "LiftBx"],
        ["--task", "LiftBox", "--region", "R9"],
        ["--task", "LiftBox", "--index", "-1"],
        ["--policy", "nowhere"],
        ["--variation", "windy"],
        ["--task", "LiftBox", "--policy", "nowhere"],
        ["--task", "LiftBox", "--policy", "nowhere", "--index", "1"],
    ],
)
def test_wrong_input_is_one_line_and_writes_nothing(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["gallery", "--root", str(tmp_path / "new"), *arguments]) == 2
    assert capsys.readouterr().err.count("error: ") == 1
    assert list(tmp_path.iterdir()) == []
