"""What hands hold and where it goes: segments about a goal, and targets that follow it."""

from dataclasses import dataclass

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.registry import get_task
from lerobot_demohlm.demonstrations.demonstration import Demonstration, load
from lerobot_demohlm.demonstrations.segmentation import groups, segment
from lerobot_demohlm.generation.carrying import Carrying
from lerobot_demohlm.generation.locomotion import LocomotionSettings

TASKS = ("StackCube", "CarryBox")


@dataclass
class Scene:
    """Stands in for a world: where things are."""

    there: dict[str, np.ndarray]

    def pose(self, name: str) -> np.ndarray:
        return self.there[name]


def begun(name: str, moved: np.ndarray | None = None) -> tuple[Demonstration, np.ndarray, np.ndarray, slice]:
    """Return a demonstration, its hands' targets about its goal, those made for a scene, and their ticks.

    Args:
        name: Of the task.
        moved: (4, 4) motion of the goal in the world; it stays where it was by default.
    """
    task, source = get_task(name), load(None, get_task(name))
    segments = segment(source, task)
    group = next(group for group in groups(segments) if group[0].held is not None)
    first = group[0].start
    hands = [("left", "right").index(entry.hand) for entry in group]
    there = {entry.name: source.T_world_objects[first, index] for index, entry in enumerate(task.objects)}
    goal = str(group[0].object)
    there[goal] = (np.eye(4) if moved is None else moved) @ there[goal]
    there["pelvis"] = source.T_world_pelvis[first]
    carrying = Carrying(Scene(there), task, source, segments, LocomotionSettings())  # type: ignore[arg-type]
    ticks = slice(first, group[0].stop)
    before = source.T_world_targets[first - 1][hands]
    return source, source.T_world_targets[ticks][:, hands], carrying.targets(group, before, {}), ticks


@pytest.mark.parametrize("name", TASKS)
def test_what_is_held_follows_its_goal_until_the_end(name: str) -> None:
    task, source = get_task(name), load(None, get_task(name))
    held = [entry for entry in segment(source, task) if entry.held is not None]
    assert {(entry.held, entry.object) for entry in held} == {(k, goal.object) for k, goal in task.goals.items()}
    assert {entry.hand for entry in held} == {side for side, _ in task.contact_pairs}
    assert all(entry.stop == len(source) for entry in held)
    assert all(entry.held is None for entry in segment(source, task, scattered=False))


@pytest.mark.parametrize("name", TASKS)
def test_the_demonstrated_scene_gives_the_demonstrated_targets(name: str) -> None:
    _, demonstrated, made, _ = begun(name)
    assert made == pytest.approx(demonstrated, abs=1e-9)


@pytest.mark.parametrize("name", TASKS)
def test_a_goal_that_is_elsewhere_moves_the_targets_with_it(name: str) -> None:
    moved = poses.planar(0.03, -0.05, 0.0)
    _, demonstrated, made, _ = begun(name, moved)
    assert made == pytest.approx(moved @ demonstrated, abs=1e-9)


@pytest.mark.parametrize("name", TASKS)
def test_the_heading_of_a_goal_is_of_no_account_where_the_task_says_so(name: str) -> None:
    """A goal turned on the spot is met as the robot stands: the hands do not turn with it."""
    source, demonstrated, _, ticks = begun(name)
    index = [entry.name for entry in get_task(name).objects].index(next(iter(get_task(name).goals.values())).object)
    there = source.T_world_objects[ticks.start, index]
    about = poses.planar(*there[:2, 3], 0.0) @ poses.planar(0.0, 0.0, 0.3) @ poses.planar(*-there[:2, 3], 0.0)
    _, _, made, _ = begun(name, about)
    assert made == pytest.approx(demonstrated, abs=1e-6)
