"""``demohlm lint-task`` passes sound tasks and names what is wrong with bad ones."""

import dataclasses
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.errors import DemoHLMError
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from gym_demohlm.simulation.worlds import Worlds
from gym_demohlm.task import ObjectSpec, Predicate, Task
from gym_demohlm.tasks.lift_box import BOX_SIZE
from lerobot_demohlm import cli
from lerobot_demohlm.checks.lint import LEAST_CHANGE, MAX_DEPTH, MAX_IMPACT_DEPTH, Settings, format_table, lint
from lerobot_demohlm.checks.overlaps import OverlapWatch
from lerobot_demohlm.demonstrations.demonstration import load
from lerobot_demohlm.experiments import lines, readme_tables

SMALL = Settings(num_resets=6, num_still=1, num_episodes=2, time_limit_s=2.0)


def failed(task: Task, *, replayed: bool = False) -> set[str]:
    """Return the names of the checks that a task fails."""
    demonstration = load(None, task) if replayed else None
    settings = dataclasses.replace(SMALL, num_episodes=1) if replayed else SMALL
    return {check.name for check in lint(task, demonstration, settings) if not check.ok}


def bad(success: Predicate) -> Task:
    """Return LiftBox with another success condition."""
    return dataclasses.replace(get_task("LiftBox"), success=success)


def test_a_sound_task_passes() -> None:
    checks = lint(get_task("LiftBox"), load(None, get_task("LiftBox")), SMALL)
    assert [check.name for check in checks if not check.ok] == []
    lines = format_table("LiftBox", checks).splitlines()
    assert lines[0] == "LiftBox" and len(lines) == len(checks) + 2
    assert all(line.endswith("yes") for line in lines[2:])


def test_the_command_ends_in_one_object(capsys: pytest.CaptureFixture[str]) -> None:
    options = "--num-resets 3 --num-still 1 --num-episodes 2 --time-limit-s 2"
    code = cli.main(["lint-task", "PressCube", *options.split()])
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert code == 0
    found = summary.pop("found")["PressCube"]
    assert found["replays: success"] == 1.0 and 0.0 < found["replays: depth"] < 5.0 and found["CPU time"] > 0.0
    settings = {"num_resets": 3, "num_still": 1, "num_episodes": 2, "seed": 0, "time_limit_s": 2.0}
    settings |= {"controller": "default", "variation": "none"}
    assert summary == {"ok": True, "failed": {"PressCube": []}, **settings}


def test_a_line_of_results_becomes_a_row_of_the_readme(tmp_path: Path) -> None:
    options = f"--num-resets 3 --num-still 1 --num-episodes 1 --time-limit-s 2 --results {tmp_path}"
    cli.main(["lint-task", "PressCube", *options.split()])
    (line,) = lines.read_measurements(tmp_path / "lint.jsonl")
    assert line["task"] == "PressCube" and line["failed"] == [] and line["found"]["replays: success"] == 1.0
    (row,) = [text for text in readme_tables.tables(tmp_path).splitlines() if text.startswith("| PressCube")]
    assert row.split("|")[2:4] == [" 1 ", " 0 "] and " pass " in row


def test_success_at_the_reset_is_caught() -> None:
    found = failed(bad(lambda sim: sim.time < 0.05))
    assert found == {"success at a reset", "success at a reset in R4"}


def test_success_of_a_robot_that_stands_still_is_caught() -> None:
    def timer(sim: Worlds) -> np.ndarray:
        return sim.time > 1.0

    assert failed(bad(timer)) == {"success standing still", "success by random commands"}


def test_success_by_chance_is_caught() -> None:
    def waved(sim: Worlds) -> np.ndarray:
        return np.abs(sim.command[:, command.ARMS][:, 0]) > 1.5

    assert failed(bad(waved)) == {"success by random commands"}


def test_a_flicker_is_caught() -> None:
    """The box passes through a thin layer on its way up."""

    def passing(sim: Worlds) -> np.ndarray:
        return np.abs(sim.pose("box")[:, 2, 3] - 0.45) < 0.03

    assert failed(bad(passing), replayed=True) == {
        "demonstration: success at the end", "demonstration: success held", "replays: success"
    }  # fmt: skip


def test_failure_at_the_reset_and_in_the_demonstration_is_caught() -> None:
    task = dataclasses.replace(bad(get_task("LiftBox").success), failures={"always": lambda sim: sim.time >= 0.0})
    expected = {"failure at a reset", "failure at a reset in R4", "failure standing still"}
    assert failed(task, replayed=True) == expected | {"demonstration: failure", "replays: success"}


def test_an_object_inside_another_is_caught() -> None:
    base = get_task("LiftBox")

    def build(spec: mujoco.MjSpec) -> None:
        base.build(spec)
        spec.geom("box").size = [0.13, 0.13, 0.10]  # 1 cm into its stand

    task = dataclasses.replace(base, build=build)
    assert "depth at a reset" in failed(task)


def test_an_impact_is_told_from_an_overlap_that_lasts() -> None:
    """A box let fall from 1 m may be found inside the floor by up to a step's way, for an instant; then it rests."""
    sim = Simulation(get_task("LiftBox"))
    watch = OverlapWatch(sim)
    worst = 0.0
    for height in np.linspace(1.0, 1.088, 11):  # m; at 4.4 m/s a step of the physics further each
        sim.reset([{"robot": [-5.0, 0.0, 0.0], "object": [0.0, 0.0, 0.0]}])
        T_world_box = sim.pose("box")
        T_world_box[:, :3, 3] = 2.0, 2.0, height + BOX_SIZE[2] / 2
        sim.set_pose("box", T_world_box)
        sim.set_velocity("box", np.zeros(6))
        for _ in range(7):
            sim.step(command.rest()[None])
        worst = max(worst, watch.deepest.depth)
    sim.close()
    assert watch.lasting.depth < 0.002 < worst <= MAX_IMPACT_DEPTH
    assert watch.deepest.where.startswith("floor in box at ")


@pytest.mark.parametrize(("geom", "counts"), [("torso_collision", False), ("left_elbow_yaw_collision", True)])
def test_what_the_trunk_leans_on_is_judged_as_an_impact(geom: str, counts: bool) -> None:
    """A box held inside the trunk for a second is deep, and does not last; one inside an arm does."""
    sim = Simulation(get_task("LiftBox"))
    watch = OverlapWatch(sim)
    for _ in range(10):
        data, T_world_box = sim.mj_data(0), sim.pose("box")
        T_world_box[:, :3, 3] = data.geom_xpos[sim.model.geom(geom).id]
        sim.set_pose("box", T_world_box)
        sim.set_velocity("box", np.zeros(6))
        watch.look(np.array([0]))
        sim.step(command.rest()[None])
    sim.close()
    assert watch.deepest.depth > MAX_DEPTH
    assert (watch.lasting.depth > MAX_DEPTH) == counts


def test_a_constant_observation_is_caught() -> None:
    """A part of the robot's head, seen from its camera, never moves."""
    base = get_task("LiftBox")

    def build(spec: mujoco.MjSpec) -> None:
        base.build(spec)
        spec.site("head_camera").parent.add_body(name="nose", pos=[0.1, 0.0, 0.0])

    nose = dataclasses.replace(base.objects[0], name="nose", position=(0.0, 0.0, 0.0), placed=False, symmetry=(0.0,))
    task = dataclasses.replace(base, build=build, objects=(*base.objects, nose), wide_form=None)
    assert failed(task) == {"observation changes"}


def test_an_upright_round_object_has_one_number_that_is_zero_by_definition() -> None:
    """Its x axis is reported where the camera heads, so its y axis is across; another number may not be constant."""
    base = get_task("LiftBox")

    def build(spec: mujoco.MjSpec) -> None:
        base.build(spec)
        spec.worldbody.add_body(name="post", mocap=True)

    post = ObjectSpec(name="post", position=(0.5, 0.3, 0.2), symmetry="any")
    task = dataclasses.replace(base, build=build, objects=(*base.objects, post), wide_form=None)
    assert failed(task) == set()
    sim = Simulation(task)
    generator = np.random.default_rng(0)
    seen = []
    for _ in range(10):
        sim.step(generator.uniform(command.LOWER, command.UPPER)[None])
        seen.append(observation.environment_state(sim)[0])
    sim.close()
    names = observation.environment_names(task)
    constant = {name for name, change in zip(names, np.ptp(seen, axis=0), strict=True) if change < LEAST_CHANGE}
    assert constant == {"post_r12.pos"}


@pytest.mark.parametrize("name", ["num_resets", "num_still", "num_episodes"])
def test_settings_that_check_nothing_are_refused(name: str) -> None:
    with pytest.raises(DemoHLMError, match=name):
        Settings(**{name: 0})
