"""The error model: errors that were put in come out of a fit, and the perceiver tells what the model says."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.errors import SceneError
from gym_demohlm.perception.error_fit import ErrorTrack, fit_model, pose_errors
from gym_demohlm.perception.error_model import Channel, ErrorModel, fitted_path, read_model
from gym_demohlm.perception.model import ModelPerceiver, _odds_after, ray_frame
from gym_demohlm.perception.perceiver import make_perceiver
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from tests.helpers.clocks import set_time

TASK = get_task("GraspCube")


def _channel(size: float, tails: float = 1.0) -> Channel:
    lengths = np.linspace(0.0, 5.0, 20)
    return Channel(
        distance_power=1.5, hidden_rate=0.8, offset=[0.001, 0.0, 0.0], axes=[[1.4, 0, 0], [0, 0.7, 0], [0, 0, 0.7]],
        normal_lengths=lengths.tolist(), error_lengths=(size * lengths**tails).tolist(),
        bias_share=0.4, correlation=0.6,
    )  # fmt: skip


def _tracks(channel: Channel, count: int, frames: int, seed: int) -> list[ErrorTrack]:
    """Return episodes whose errors a channel makes."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(count):
        bias, noise = rng.standard_normal((1, 3)), [rng.standard_normal(3)]
        for _ in range(frames - 1):
            noise.append(channel.correlation * noise[-1] + np.sqrt(1 - channel.correlation**2) * rng.standard_normal(3))
        g = np.sqrt(channel.bias_share) * bias + np.sqrt(1 - channel.bias_share) * np.array(noise)
        distance, visible = np.linspace(1.4, 0.4, frames), rng.uniform(0.3, 1.0, frames)
        errors = channel.errors(g, distance, visible)[:, None]
        valid = rng.random((frames, 1)) > 0.1
        found.append(
            ErrorTrack(distance=distance[:, None], visible=visible[:, None], valid=valid, shift=errors, turn=errors)
        )
    return found


@pytest.mark.parametrize("tails", [1.0, 2.0])
def test_a_fit_finds_the_errors_that_were_put_in(tails: float) -> None:
    true = _channel(0.002, tails)
    model = fit_model(TASK, _tracks(true, 60, 150, 0), {"perception": "synthetic"})
    found = model.objects[0].shift
    assert found.distance_power == pytest.approx(1.5, abs=0.2) and found.hidden_rate == pytest.approx(0.8, abs=0.2)
    assert found.bias_share == pytest.approx(0.4, abs=0.12) and found.correlation == pytest.approx(0.6, abs=0.1)
    assert model.objects[0].lost_when_seen == pytest.approx(0.1, abs=0.02)
    assert model.objects[0].found_when_seen == pytest.approx(0.9, abs=0.05)
    fresh, again = _tracks(true, 60, 150, 1), _tracks(found, 60, 150, 2)
    for share in (0.5, 0.9):
        expected, got = (
            np.quantile(np.linalg.norm(np.concatenate([track.shift for track in each]), axis=-1), share)
            for each in (fresh, again)
        )
        assert got == pytest.approx(expected, rel=0.15)


def test_errors_of_symmetric_and_round_things_are_the_least_of_those_that_look_the_same() -> None:
    rng = np.random.default_rng(0)
    truth = poses.pose(rng.uniform(0.5, 1.0, (5, 3)), rng.standard_normal((5, 4)))
    turned = truth @ poses.planar(0.0, 0.0, np.pi / 2)
    (cube,) = TASK.objects
    _, turn = pose_errors(turned, truth, cube)
    np.testing.assert_allclose(turn, 0.0, atol=1e-7)
    bottle = get_task("PourWater").objects[0]
    _, turn = pose_errors(truth @ poses.planar(0.0, 0.0, 1.234), truth, bottle)
    np.testing.assert_allclose(turn, 0.0, atol=1e-7)
    nearer = truth.copy()
    nearer[:, :3, 3] *= 0.99
    shift, _ = pose_errors(nearer, truth, cube)
    np.testing.assert_allclose(shift[:, 0], -0.01 * np.linalg.norm(truth[:, :3, 3], axis=1), rtol=1e-6)
    np.testing.assert_allclose(shift[:, 1:], 0.0, atol=1e-9)


def test_the_frame_of_a_ray_is_a_rotation() -> None:
    R = ray_frame(np.random.default_rng(1).standard_normal((20, 3)))
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)


FITTED = [name for name in sorted(all_tasks()) if fitted_path(get_task(name)).is_file()]


def test_every_task_has_a_fitted_model_and_another_says_how_to_get_one() -> None:
    assert set(FITTED) == set(all_tasks())
    with pytest.raises(SceneError, match="fit-perception --task Unfitted"):
        ModelPerceiver(replace(get_task("LiftBox"), name="Unfitted"), 1)


@pytest.mark.parametrize("name", FITTED)
def test_a_fitted_model_has_its_hash(name: str) -> None:
    task = get_task(name)
    model = read_model(fitted_path(task), task)
    assert model.origin["perception"] == "rgbd" and model.origin["frames"] > 100
    for entry in model.objects:
        assert 0.0 <= entry.shift.bias_share <= 1.0 and 0.0 <= entry.turn.correlation < 1.0
        length = entry.shift.error_lengths[6] * float(entry.shift.scale(np.array(1.0), np.array(1.0)))
        assert 1e-5 < length < 0.03  # m, the median at 1 m


def test_a_changed_model_or_one_of_another_task_is_an_error(tmp_path: Path) -> None:
    content = json.loads(fitted_path(TASK).read_text())
    content["objects"][0]["shift"]["bias_share"] = 0.123
    (tmp_path / "changed.json").write_text(json.dumps(content))
    with pytest.raises(SceneError, match="hash"):
        read_model(tmp_path / "changed.json", TASK)
    with pytest.raises(SceneError, match="GraspCube"):
        read_model(fitted_path(TASK), get_task("LiftBox"))
    with pytest.raises(SceneError, match="fit-perception"):
        read_model(tmp_path / "none.json", TASK)


def _watched(
    model: ErrorModel, seed: int, rows: int = 1, task: Task = TASK
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return told and true positions (steps, rows, 3) and validity (steps, rows) of a robot that stands."""
    sim = Simulation(task, rows)
    sim.reset([{"robot": [-0.45, 0.05, 0.1], "object": [0.0, -0.05, 0.3]}] * rows)
    perceiver, exact = ModelPerceiver(task, rows, model=model), make_perceiver("exact", task, rows)
    perceiver.begin(np.arange(rows), [seed + row for row in range(rows)])
    told, truth, valid = [], [], []
    for _ in range(6):
        sim.step(sim.command)
        estimate = perceiver.observe(sim, np.arange(rows))
        told.append(estimate.T_camera_object[:, 0, :3, 3])
        valid.append(estimate.valid[:, 0])
        truth.append(exact.observe(sim, np.arange(rows)).T_camera_object[:, 0, :3, 3])
    sim.close()
    return np.array(told), np.array(truth), np.array(valid)


def test_an_episode_is_a_function_of_its_seed_alone_or_among_others() -> None:
    model = read_model(fitted_path(TASK), TASK)
    alone, truth, _ = _watched(model, 5)
    among, _, _ = _watched(model, 4, rows=3)
    np.testing.assert_array_equal(among[:, 1], alone[:, 0])
    assert (among[:, 0] != alone[:, 0]).any()
    off = np.linalg.norm(alone - truth, axis=-1)
    assert 0.0 < off.max() < 0.05


def test_what_is_lost_is_held_and_not_valid() -> None:
    model = read_model(fitted_path(TASK), TASK)
    (entry,) = model.objects
    always = replace(entry, lost_when_seen=1.0, lost_when_hidden=1.0, found_when_seen=0.0, found_when_hidden=0.0)
    told, _, valid = _watched(replace(model, objects=(always,)), 0)
    assert not valid.any()
    np.testing.assert_allclose(told[:, 0], np.broadcast_to([1.0, 0.0, 0.0], told[:, 0].shape), atol=0.05)  # never seen


@pytest.mark.parametrize(("lost", "found"), [(0.1, 0.6), (0.3, 0.7), (0.0, 0.2), (0.0, 0.0), (0.02, 0.05)])
def test_odds_of_several_looks_are_those_of_the_time_they_take(lost: float, found: float) -> None:
    def chain(steps: float) -> np.ndarray:
        p, q = _odds_after(np.array([lost]), np.array([found]), np.array([steps]))
        return np.array([[1.0 - p[0], p[0]], [q[0], 1.0 - q[0]]])

    np.testing.assert_array_equal(chain(1.0), [[1.0 - lost, lost], [found, 1.0 - found]])
    np.testing.assert_allclose(np.linalg.matrix_power(chain(0.4), 5), np.linalg.matrix_power(chain(1.0), 2), atol=1e-12)
    np.testing.assert_allclose(chain(0.0), np.eye(2), atol=1e-12)


def test_errors_change_and_grow_old_with_time_and_not_with_looks() -> None:
    model, rows = read_model(fitted_path(TASK), TASK), np.arange(48)
    (entry,) = model.objects
    never = replace(entry, lost_when_seen=1.0, lost_when_hidden=1.0, found_when_seen=0.0, found_when_hidden=0.0)
    slow = replace(never, shift=replace(entry.shift, correlation=0.9), turn=replace(entry.turn, correlation=0.9))
    sim = Simulation(TASK, len(rows))
    perceiver = ModelPerceiver(TASK, len(rows), model=replace(model, objects=(slow,)))
    perceiver.begin(rows, rows.tolist())
    first = perceiver.observe(sim, rows)
    perceiver._age[:] = 0.0  # as if it had been seen now
    begun = perceiver._noise.copy()
    for index in range(1, 11):
        set_time(sim, 0.04 * index)
        last = perceiver.observe(sim, rows)
    sim.close()
    assert not first.valid.any() and not last.valid.any()
    np.testing.assert_allclose(last.age_s, 0.4, atol=1e-9)
    kept = np.corrcoef(begun.ravel(), perceiver._noise.ravel())[0, 1]
    assert kept == pytest.approx(0.9**4, abs=0.15)  # of ten looks as of ten steps it would be 0.35


def test_the_first_sight_has_odds_of_its_own() -> None:
    """What was lost may be behind another object, which nothing tells; what was never seen comes into the picture."""
    rng, tracks = np.random.default_rng(4), _tracks(_channel(0.002), 60, 150, 3)
    assert (
        fit_model(TASK, [replace(track, valid=track.valid | True) for track in tracks], {}).objects[0].found_first
        is None
    )
    late = []
    for track in tracks:
        first, valid = 3 + rng.geometric(0.4), rng.random(track.valid.shape) < 0.6
        valid[:first], valid[first] = False, True
        visible = track.visible.copy()
        visible[:4] = 0.0  # out of the picture; each later frame may show it
        late.append(replace(track, valid=valid, visible=visible))
    model = fit_model(TASK, late, {})
    assert model.objects[0].found_first == pytest.approx(0.4, abs=0.12)

    (entry,) = read_model(fitted_path(TASK), TASK).objects
    once = replace(entry, lost_when_seen=1.0, lost_when_hidden=1.0, found_when_seen=0.0, found_when_hidden=0.0)
    model = replace(read_model(fitted_path(TASK), TASK), objects=(replace(once, found_first=1.0),))
    _, _, valid = _watched(model, 0)
    np.testing.assert_array_equal(valid[:, 0].ravel()[:4], [False, True, False, False])


def test_a_file_says_what_was_fitted_and_no_more(tmp_path: Path) -> None:
    task = get_task("CarryBox")
    model = read_model(fitted_path(task), task)
    assert [entry.found_first is None for entry in model.objects] == [True, False]
    model.write(tmp_path / "model.json")
    assert (tmp_path / "model.json").read_bytes() == fitted_path(task).read_bytes()
    assert read_model(tmp_path / "model.json", task) == model
