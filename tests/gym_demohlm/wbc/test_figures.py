"""A robot's way through a script of commands becomes figures and a film that hold what they should."""

import json
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from gym_demohlm.control import command
from gym_demohlm.errors import SceneError
from gym_demohlm.timing import CONTROL_DT
from gym_demohlm.wbc.evaluation import episodes, figures, intervals, performance

_SHORT = (
    performance.Scene(label="stand", seconds=0.4),
    performance.Scene(label="arms", seconds=0.6, arms=(-1.0, 0.2, 0.0, 0.6, 0.0, 0.0, 0.0)),
    performance.Scene(label="push", seconds=0.2, push=(0.0, 0.3)),
)


@pytest.fixture(scope="module")
def performed() -> tuple[performance.Recorder, performance.Take]:
    recorder = performance.Recorder(None)
    return recorder, performance.perform(recorder, _SHORT)


def test_a_take_holds_every_control_tick(performed: tuple[performance.Recorder, performance.Take]) -> None:
    _, take = performed
    assert not take.fell
    assert len(take.labels) == len(take.commands) == len(take.states) == 60
    np.testing.assert_allclose(np.diff(take.states[:, 0]), CONTROL_DT, atol=1e-9)
    arms = take.commands[:, command.ARMS]
    fastest = np.abs(np.diff(arms, axis=0)).max() / CONTROL_DT
    assert fastest == pytest.approx(performance.ARM_SPEED, rel=1e-6)
    assert arms[49, 0] == pytest.approx(-1.0)  # shoulder pitch, both sides
    assert arms[49, 7] == pytest.approx(-1.0)
    assert arms[49, 1] == pytest.approx(-arms[49, 8])  # shoulder roll is mirrored


def test_the_push_changes_the_velocity_at_once(performed: tuple[performance.Recorder, performance.Take]) -> None:
    recorder, take = performed
    sideways = []
    for tick in (49, 50):
        recorder.show(take.states[tick])
        sideways.append(episodes.tracked(recorder)["sideways"][0])
    assert sideways[1] - sideways[0] > 0.15


def test_every_command_of_the_script_is_admissible_and_all_are_used() -> None:
    used = set()
    for scene in performance.SCRIPT:
        for column, value in scene.told.items():
            assert command.LOWER[column] <= value <= command.UPPER[column]
            used.add(column)
    assert used == set(range(7))
    assert any(scene.arms for scene in performance.SCRIPT)
    assert any(any(scene.push) for scene in performance.SCRIPT)


def test_tracking_figure_and_film(performed: tuple[performance.Recorder, performance.Take], tmp_path: Path) -> None:
    recorder, take = performed
    figures.draw_tracking(recorder, take, tmp_path / "tracking.png")
    picture = np.asarray(Image.open(tmp_path / "tracking.png").convert("RGB"))
    assert picture.shape[0] > 500
    assert picture.std() > 10
    short = performance.Take(labels=take.labels[:6], commands=take.commands[:6], states=take.states[:6], fell=False)
    performance.film(recorder, short, tmp_path / "film.mp4", shadows=False)
    with av.open(str(tmp_path / "film.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 3
    assert frames[0].shape == (480, 640, 3)
    middle = frames[0][120:400, 220:420]
    assert middle.std() > 1.5 * frames[0][:40, -200:].std()  # a robot in the middle, sky in the corner


def test_push_survival_falls_with_the_speed(tmp_path: Path) -> None:
    found = figures.push_survival(None, num_worlds=1, speeds=(0.05, 4.0), num_threads=1)
    assert set(found) == set(figures.PUSHED)
    assert found["standing"][0] == 1.0  # a nudge
    assert all(shares[1] == 0.0 for shares in found.values())  # nobody withstands 4 m/s
    curve = {name: [shares[0]] * len(figures.PUSH_SPEEDS) for name, shares in found.items()}
    figures.draw_push_survival(curve, 1, tmp_path / "pushes.png")
    assert Image.open(tmp_path / "pushes.png").size[0] > 500


def test_wilson_interval_holds_the_share() -> None:
    low, high = intervals.wilson(np.array([0.0, 0.5, 1.0]), 24)
    assert np.all((low <= [0, 0.5, 1]) & (high >= [0, 0.5, 1]))
    assert high[0] == pytest.approx(0.138, abs=0.001)  # z^2 / (n + z^2)
    assert low[1] + high[1] == pytest.approx(1.0)


def test_learning_curve_reads_a_run(tmp_path: Path) -> None:
    names = ["error/walk_vx", "error/walk_vy", "error/walk_yaw_rate"]
    names += [f"error/stand_{name}" for name in ("height", "pitch", "roll", "yaw")]
    lines = []
    for index in range(1, 9):
        errors = {name: 1.0 / index for name in names}
        falls = {"ticks_between_falls": 50.0 * index, "ticks_between_falls_pushed": 40.0 * index}
        levels = {"level": index / 8, "push_level": index / 16}
        lines.append({"steps": 250_000 * index, "seconds": 60.0 * index, **errors, **falls, **levels})
    (tmp_path / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    figures.draw_learning(tmp_path, tmp_path / "without.png")
    found = {"walking/linear_velocity": 0.2, "walking/yaw_rate": 0.3, "survival": 0.9, "survival_pushed": 0.8}
    evaluated = {f"deployment/{name}": value for name, value in found.items()}
    (tmp_path / "evaluation.jsonl").write_text(json.dumps({"steps": 1_000_000, "seconds": 240.0, **evaluated}) + "\n")
    figures.draw_learning(tmp_path, tmp_path / "with.png")
    without, with_dots = (np.asarray(Image.open(tmp_path / f"{name}.png")) for name in ("without", "with"))
    assert without.shape == with_dots.shape
    assert (without != with_dots).any()


def test_all_of_them_land_in_a_folder(tmp_path: Path) -> None:
    found = figures.draw(tmp_path / "docs", num_threads=1, script=_SHORT[:1], num_pushed=1)
    assert {path.name for path in (tmp_path / "docs").iterdir()} == set(found["figures"])
    assert not found["fell"]
    assert found["seconds"] == pytest.approx(0.4)
    assert found["push_survival"].keys() == figures.PUSHED.keys()
    json.dumps(found)


def test_a_folder_without_a_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"log\.jsonl"):
        figures.draw_learning(tmp_path, tmp_path / "learning.png")


def test_runs_are_drawn_over_one_another(tmp_path: Path) -> None:
    for index, name in enumerate(("full", "without_reference")):
        (tmp_path / name).mkdir()
        found = {"survival": 0.5 + 0.1 * index, "walking/linear_velocity": 0.2, "standing/torso_pitch": 0.1}
        line = {"steps": 1_000_000, **{f"deployment/{key}": value for key, value in found.items()}}
        (tmp_path / name / "evaluation.jsonl").write_text(json.dumps(line) + "\n")
    runs = [tmp_path / "full", tmp_path / "without_reference"]
    figures.draw_comparison(runs, tmp_path / "both.png")
    figures.draw_comparison(runs[:1], tmp_path / "one.png")
    both, one = (np.asarray(Image.open(tmp_path / f"{name}.png")) for name in ("both", "one"))
    assert both.shape == one.shape
    assert (both != one).any()
    with pytest.raises(SceneError, match=r"evaluation\.jsonl"):
        figures.draw_comparison([tmp_path], tmp_path / "none.png")
    with pytest.raises(SceneError, match="7 runs; expected at most 6"):
        figures.draw_comparison(7 * runs[:1], tmp_path / "none.png")
