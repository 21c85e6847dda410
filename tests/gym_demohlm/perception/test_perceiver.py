"""Perceivers: exact ones have today's bits, seeing ones are near the truth, and nothing flips."""

from collections.abc import Iterator
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.envs import observation
from gym_demohlm.errors import UnknownNameError
from gym_demohlm.perception.equivalents import steady_equivalent
from gym_demohlm.perception.estimate import PoseEstimate
from gym_demohlm.perception.perceiver import make_perceiver
from gym_demohlm.perception.rgbd import RgbdPerceiver, RgbdSettings
from gym_demohlm.perception.seeing import Mounting
from gym_demohlm.perception.tracker import Track, Tracker
from gym_demohlm.perception.visual_model import Frame, VisualModel
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.simulation import Simulation


@pytest.mark.parametrize("name", sorted(all_tasks()))
def test_exact_poses_have_the_bits_of_the_observation(name: str) -> None:
    task = get_task(name)
    sim = Simulation(task, 2)
    sim.reset([task.sample("R3", np.random.default_rng(seed)) for seed in range(2)])
    estimate = make_perceiver("exact", task, 2).observe(sim, np.arange(2))
    assert estimate.environment_state().tobytes() == observation.environment_state(sim).tobytes()
    assert estimate.valid.all() and (estimate.age_s == 0).all()
    sim.close()


def test_an_unknown_source_is_an_error() -> None:
    with pytest.raises(UnknownNameError, match="'exact'"):
        make_perceiver("exac", get_task("LiftBox"), 1)


def _watched(settings: RgbdSettings, seed: int, steps: int = 6) -> tuple[list[bytes], np.ndarray]:
    """Return what is told of a robot that stands, and its last error from the exact observation."""
    task = get_task("GraspCube")
    sim = Simulation(task, 1)
    sim.reset([{"robot": [-0.45, 0.05, 0.1], "object": [0.0, -0.05, 0.3]}])
    perceiver = RgbdPerceiver(task, 1, settings)
    perceiver.begin(np.array([0]), [seed])
    told = []
    for _ in range(steps):
        sim.step(sim.command)
        told.append(perceiver.observe(sim, np.array([0])).environment_state())
    error = told[-1][0] - observation.environment_state(sim)[0]
    perceiver.close()
    sim.close()
    return [each.tobytes() for each in told], error


def test_the_same_seed_sees_the_same_bits_near_the_truth_and_another_seed_others() -> None:
    first, error = _watched(RgbdSettings(), 5)
    again, _ = _watched(RgbdSettings(), 5)
    other, _ = _watched(RgbdSettings(), 6)
    assert first == again and first != other
    assert np.abs(error[:3]).max() < 0.015 and np.abs(error[3:]).max() < 0.12


def test_a_camera_that_is_mounted_otherwise_shifts_what_is_told() -> None:
    _, straight = _watched(RgbdSettings(), 5, 3)
    _, off = _watched(RgbdSettings(mounting=Mounting(camera_turn=np.radians(2.0))), 5, 3)
    distance = 0.9  # m to the cube, about
    assert 0.2 * distance * np.radians(2.0) < np.linalg.norm(off[:3] - straight[:3]) < 1.5 * distance * np.radians(2.0)


@pytest.mark.parametrize("source", ["rgbd", "remote,timeout_s=0.01"])
@pytest.mark.parametrize(("name", "passes"), [("GraspCube", 1), ("PourWater", 2)])
def test_only_glass_in_the_picture_is_looked_through(
    source: str, name: str, passes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[int] = []
    draw = VisualModel.depth_and_ids

    def counted(self: VisualModel, *arguments: Any) -> Frame:
        drawn.append(1)
        return draw(self, *arguments)

    monkeypatch.setattr(VisualModel, "depth_and_ids", counted)
    task = get_task(name)
    with closing(Simulation(task, 1)) as sim, closing(make_perceiver(source, task, 1)) as perceiver:
        sim.reset([task.sample("R1", np.random.default_rng(0))])
        perceiver.begin(np.array([0]), [0])
        perceiver.observe(sim, np.array([0]))
    assert len(drawn) == passes  # the robot's shapes that only collide are pale, but no glass


def test_a_symmetric_object_does_not_flip_while_its_border_trembles() -> None:
    entry = get_task("GraspCube").objects[0]
    camera = poses.planar(0.0, 0.0, 0.0)
    rng = np.random.default_rng(0)
    last, told = None, []
    for _ in range(200):
        T = poses.planar(0.5, 0.0, np.radians(45.0 + 2.5 * rng.standard_normal()))
        last = steady_equivalent(T, entry, camera, last)
        told.append(poses.yaw(last))
    assert np.abs(np.diff(told)).max() < np.radians(40.0)
    turned = steady_equivalent(poses.planar(0.5, 0.0, np.radians(70.0)), entry, camera, poses.planar(0.5, 0, 0.8))
    assert abs(np.degrees(poses.yaw(turned))) < 45.0  # it does where the object has really turned


def test_an_environment_observes_and_looks_by_what_it_sees() -> None:
    seen, exact = (gym.make("DemoHLM/GraspCube-v0", perception=source).unwrapped for source in ("rgbd", "exact"))
    told = []
    for env in (seen, exact):
        first, _ = env.reset(seed=3, options={"region": "R1"})
        sim = env.get_wrapper_attr("sim")
        last = [env.step(sim.command[0].astype(np.float32))[0] for _ in range(4)][-1]
        told.append((first["environment_state"], last["environment_state"], sim.neck_positions))
    for observed, true in zip(*told, strict=True):
        assert 0.0 < np.abs(observed - true).max() < 0.2  # another one, but not far off; the neck's angles, too
    assert exact.get_wrapper_attr("sim").p_camera_gaze is None
    seen.close()
    exact.close()


def test_an_environment_with_an_unknown_perception_is_an_error() -> None:
    with pytest.raises(UnknownNameError, match="perception"):
        gym.make("DemoHLM/GraspCube-v0", perception="eyes")


@pytest.mark.parametrize("seed", [2, 4, 13])
def test_an_object_that_comes_back_over_the_pictures_border_is_where_it_was(seed: int) -> None:
    task = get_task("LiftBox")
    with closing(Simulation(task)) as sim, closing(make_perceiver("rgbd", task, 1)) as perceiver:
        sim.reset([task.sample("R1", np.random.default_rng(970000 + seed))])
        perceiver.begin(np.array([0]), [seed])
        pitch, valid, errors = float(sim.neck_positions[0, 1]), [], []
        away = [0.0, 0.0, *np.linspace(-0.1, -1.0, 8), *np.linspace(-0.6, 0.0, 24)]
        for offset in away:
            sim.set_joint("neck_pitch_joint", pitch + offset)
            estimate = perceiver.observe(sim, np.array([0]))
            T_camera_box = poses.invert(sim.pose("head_camera")[0]) @ sim.pose("box")[0]
            errors.append(float(np.linalg.norm((estimate.T_camera_object[0, 0] - T_camera_box)[:3, 3])))
            valid.append(bool(estimate.valid[0, 0]))
    assert valid[0] and not any(valid[8:12]) and all(valid[-5:])
    assert max(errors[-5:]) < 0.005


def test_furniture_is_looked_at_twice_a_second_however_often_there_is_a_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was seen counts as seen in between; what was not grows older with the world's time."""
    looked: list[str] = []
    update = Tracker.update

    def noted(self: Tracker, *arguments: Any) -> Track | None:
        looked.append(self.shape.mesh.name)
        return update(self, *arguments)

    monkeypatch.setattr(Tracker, "update", noted)
    task, row = get_task("PushCube"), np.array([0])
    for dt_s in (0.1, 0.04):
        looked.clear()
        with closing(Simulation(task, 1)) as sim, closing(RgbdPerceiver(task, 1)) as perceiver:
            sim.reset([task.sample("R1", np.random.default_rng(0))])
            perceiver.begin(row, [0])
            told = list(_each(perceiver, sim, dt_s, 2.4))
            assert 20 <= looked.count("field") <= 24  # until it is known where it stands
            looked.clear()
            told += list(_each(perceiver, sim, dt_s, 2.0))
            assert looked.count("cube") == round(2.0 / dt_s) and looked.count("field") == 4
            assert all(estimate.valid.all() and (estimate.age_s == 0.0).all() for estimate in told)
            looked.clear()
            sim.set_joint("neck_pitch_joint", -1.0)  # it looks up
            told = list(_each(perceiver, sim, dt_s, 1.6))
            assert looked.count("field") in (3, 4) and not told[-1].valid.any()
            assert told[-1].age_s[0, 0] == pytest.approx(len(told) * dt_s)
            waited_s = len(told) * dt_s - told[-1].age_s[0, 1]  # until it was looked at and found gone
            assert -1e-6 < waited_s < 0.5 + 1e-6


def _each(perceiver: RgbdPerceiver, sim: Simulation, dt_s: float, for_s: float) -> Iterator[PoseEstimate]:
    """Look at a world that stands still while its time goes on."""
    for _ in range(round(for_s / dt_s)):
        yield perceiver.observe(sim, np.array([0]))
        snapshot = sim.snapshot()
        snapshot["physics"][:, 0] += dt_s
        sim.restore(snapshot)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_cabinet_of_which_the_top_is_seen_stands_behind_its_door(seed: int) -> None:
    """A robot that hangs in a gantry, or leans, sees a part of it first, which looks like other parts."""
    task, row = get_task("OpenCabinet"), np.array([0])
    with closing(Simulation(task, 1)) as sim, closing(RgbdPerceiver(task, 1)) as perceiver:
        sim.reset([task.sample("R1", np.random.default_rng(980000 + seed))])
        perceiver.begin(row, [seed])
        pitch = float(sim.neck_positions[0, 1])
        for offset in (*[-0.45] * 6, *np.linspace(-0.45, 0.0, 6)):
            sim.set_joint("neck_pitch_joint", pitch + offset)
            estimate = next(_each(perceiver, sim, 0.1, 0.1))
            T_camera_cabinet = poses.invert(sim.pose("head_camera")[0]) @ sim.pose("cabinet")[0]
            apart = poses.invert(T_camera_cabinet) @ estimate.T_camera_object[0, 1]
            if estimate.valid[0, 1]:
                assert np.linalg.norm(apart[:3, 3]) < 0.05
                assert np.linalg.norm(poses.rotation_vector(apart[:3, :3])) < np.radians(5.0)
    assert estimate.valid[0, 1]
