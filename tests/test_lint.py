"""``demohlm lint-task`` passes sound tasks and names what is wrong with bad ones."""

import dataclasses
import json

import mujoco
import numpy as np
import pytest

from gym_demohlm.control import command
from gym_demohlm.errors import DemoHLMError
from gym_demohlm.task import Predicate, Task, get_task
from gym_demohlm.worlds import Worlds
from lerobot_demohlm import cli
from lerobot_demohlm.demonstration import load
from lerobot_demohlm.lint import Settings, format_table, lint

SMALL = Settings(num_resets=6, num_still=1, num_random=2, time_limit_s=2.0)


def failed(task: Task, *, replayed: bool = False) -> set[str]:
    """Return the names of the checks that a task fails."""
    demonstration = load(None, task) if replayed else None
    return {check.name for check in lint(task, demonstration, SMALL) if not check.ok}


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
    options = "--num-resets 3 --num-still 1 --num-random 2 --time-limit-s 2"
    code = cli.main(["lint-task", "PressCube", *options.split()])
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert code == 0
    settings = {"num_resets": 3, "num_still": 1, "num_random": 2, "seed": 0, "time_limit_s": 2.0}
    assert summary == {"ok": True, "failed": {"PressCube": []}, **settings}


def test_success_at_the_reset_is_caught() -> None:
    found = failed(bad(lambda sim: sim.time < 0.05))
    assert found == {"success at a reset"}


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

    assert failed(bad(passing), replayed=True) == {"demonstration: success at the end", "demonstration: success held"}


def test_failure_at_the_reset_and_in_the_demonstration_is_caught() -> None:
    task = dataclasses.replace(bad(get_task("LiftBox").success), failures={"always": lambda sim: sim.time >= 0.0})
    expected = {"failure at a reset", "failure standing still", "demonstration: failure"}
    assert failed(task, replayed=True) == expected


def test_an_object_inside_another_is_caught() -> None:
    base = get_task("LiftBox")

    def build(spec: mujoco.MjSpec) -> None:
        base.build(spec)
        spec.geom("box").size = [0.13, 0.13, 0.10]  # 1 cm into its stand

    task = dataclasses.replace(base, build=build)
    assert "depth at a reset" in failed(task)


def test_a_constant_observation_is_caught() -> None:
    """A part of the robot's head, seen from its camera, never moves."""
    base = get_task("LiftBox")

    def build(spec: mujoco.MjSpec) -> None:
        base.build(spec)
        spec.site("head_camera").parent.add_body(name="nose", pos=[0.1, 0.0, 0.0])

    nose = dataclasses.replace(base.objects[0], name="nose", position=(0.0, 0.0, 0.0), placed=False, symmetry=(0.0,))
    task = dataclasses.replace(base, build=build, objects=(*base.objects, nose))
    assert failed(task) == {"observation changes"}


@pytest.mark.parametrize("name", ["num_resets", "num_still", "num_random"])
def test_settings_that_check_nothing_are_refused(name: str) -> None:
    with pytest.raises(DemoHLMError, match=name):
        Settings(**{name: 0})
