"""An attempt is a function of its arguments; a run ends in one dataset whatever its workers, killed or not."""

import dataclasses
import hashlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from gym_demohlm.errors import DatasetError, UnknownNameError
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from gym_demohlm.simulation.judge import OUTCOMES
from lerobot_demohlm.datasets.episode import Episode
from lerobot_demohlm.datasets.variation import PLAIN
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.generation import stages
from lerobot_demohlm.generation.attempt import Attempts, attempt, initial_state
from lerobot_demohlm.generation.locomotion import LocomotionSettings
from lerobot_demohlm.generation.request import BLOCK_SIZE, GenerationRequest, summary_json
from lerobot_demohlm.generation.runner import generate

TASK = get_task("LiftBox")
PLAIN_SETTINGS = stages.Settings(variation=PLAIN)  # commands are executed as they are recorded


@pytest.fixture(scope="module")
def demonstration() -> Demonstration:
    return demonstrations.load(task=TASK)


@pytest.fixture(scope="module")
def episodes(demonstration: Demonstration) -> list[Episode]:
    """Return three attempts made side by side."""
    attempts = Attempts(TASK, demonstration, "R1", seed=7, num_worlds=3, settings=PLAIN_SETTINGS)
    made = attempts.run(range(3))
    attempts.close()
    return made


def same(first: Episode, second: Episode) -> bool:
    """Tell whether two episodes agree in every bit."""
    a, b = dataclasses.asdict(first), dataclasses.asdict(second)
    arrays = {key for key, value in a.items() if isinstance(value, np.ndarray)}
    return all(a[key].tobytes() == b[key].tobytes() for key in arrays) and all(
        a[key] == b[key] for key in a.keys() - arrays
    )


def digest(root: Path) -> dict[str, str]:
    """Return a hash of every file under a directory."""
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def test_starts_are_drawn_from_the_region_and_never_twice() -> None:
    starts = [initial_state(TASK, "R1", seed, index) for seed in range(3) for index in range(50)]
    assert starts == [initial_state(TASK, "R1", seed, index) for seed in range(3) for index in range(50)]
    robots = np.array([start["robot"] for start in starts])
    assert len(np.unique(robots[:, 0])) == len(starts)
    assert ((robots[:, 0] >= -0.6) & (robots[:, 0] <= -0.3)).all()
    objects = np.array([start["object"] for start in starts])
    assert (np.abs(objects[:, 2]) <= math.pi / 4).all()
    assert np.ptp(objects[:, 2]) > 1.2


def test_attempts_succeed(episodes: list[Episode]) -> None:
    assert [episode.outcome for episode in episodes] == ["success"] * 3
    for episode in episodes:
        assert episode.stage == stages.MANIPULATION
        assert episode.success[-10:].all()
        assert not episode.success[: len(episode.success) // 2].any()
        assert episode.length_s == pytest.approx(len(episode.action) / 10)
        assert episode.length_s <= TASK.episode_length_s


def test_an_attempt_alone_has_the_same_bits_as_in_a_batch(
    demonstration: Demonstration, episodes: list[Episode]
) -> None:
    assert same(attempt(TASK, demonstration, "R1", 7, 1, PLAIN_SETTINGS), episodes[1])


def test_recorded_actions_reproduce_the_episode(episodes: list[Episode]) -> None:
    """What a dataset stores, sent to a fresh simulation, leads to the same success."""
    episode = episodes[0]
    sim = Simulation(TASK)
    sim.reset([episode.initial_state])
    success = []
    for action in episode.action:
        sim.step(action[None].astype(np.float64))
        success.append(bool(sim.success()[0]))
    sim.close()
    np.testing.assert_array_equal(success, episode.success)


def test_walking_comes_first_and_stops(episodes: list[Episode]) -> None:
    """Velocities are commanded at the beginning only; arms and torso move afterwards."""
    for episode in episodes:
        moving = np.flatnonzero(np.abs(episode.action[:, :3]).max(axis=1) > 0)
        assert moving[0] == 0
        assert moving[-1] < len(episode.action) - 60
        at_rest = episode.action[: moving[-1], 3:]
        np.testing.assert_array_equal(at_rest, np.broadcast_to(at_rest[0], at_rest.shape))


def test_a_goal_out_of_reach_is_off_course(demonstration: Demonstration) -> None:
    impatient = LocomotionSettings(max_ticks=10)
    attempts = Attempts(
        TASK, demonstration, "R3", 0, settings=dataclasses.replace(PLAIN_SETTINGS, locomotion=impatient)
    )
    episode = attempts.run([0])[0]
    attempts.close()
    assert (episode.outcome, episode.stage) == ("off_course", stages.LOCOMOTION)
    assert len(episode.action) >= 10


def test_a_target_out_of_reach_is_ik_failed(demonstration: Demonstration) -> None:
    """Hands that are asked to reach a metre past the sides of the box do not get there."""
    targets = demonstration.hand_targets.copy()
    targets[:, :, 1] += [1.0, -1.0]
    attempts = Attempts(TASK, dataclasses.replace(demonstration, hand_targets=targets), "R1", 0, 1, PLAIN_SETTINGS)
    episode = attempts.run([0])[0]
    attempts.close()
    assert (episode.outcome, episode.stage) == ("ik_failed", stages.PRE_MANIPULATION)


def test_hands_that_do_not_squeeze_fail_by_name(demonstration: Demonstration) -> None:
    """With the palms 10 cm beside the box nothing is lifted, and that is no success."""
    targets = demonstration.hand_targets.copy()
    targets[:, :, 1] += [0.1, -0.1]
    attempts = Attempts(TASK, dataclasses.replace(demonstration, hand_targets=targets), "R1", 0, 1, PLAIN_SETTINGS)
    episode = attempts.run([0])[0]
    attempts.close()
    assert episode.outcome == "timeout"
    assert not episode.success.any()


def request(root: Path, **changes: object) -> GenerationRequest:
    base = GenerationRequest(
        task="LiftBox", region="R1", seed=3, root=root, num_attempts=5, block_size=1, show_progress=False
    )
    return dataclasses.replace(base, **changes)


@pytest.mark.slow
def test_the_dataset_does_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    summaries = [generate(request(tmp_path / f"w{workers}", num_workers=workers)) for workers in (1, 2, 5)]
    assert digest(tmp_path / "w1") == digest(tmp_path / "w2") == digest(tmp_path / "w5")
    first, *others = (dataclasses.replace(summary, episodes_per_hour=0.0) for summary in summaries)
    assert others == [first, first]
    assert first.attempts == 5
    assert sum(first.outcomes.values()) == 5
    assert first.outcomes.keys() == set(OUTCOMES)
    assert first.success_rate == first.successes / 5
    assert json.loads(json.dumps(summary_json(first)))["task"] == "LiftBox"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["w1", "w2", "w5"]


@pytest.mark.slow
def test_a_killed_run_resumes_into_the_same_dataset(tmp_path: Path) -> None:
    num_attempts = BLOCK_SIZE + 4  # a block that is soon there, and one that is not
    command = [
        *(sys.executable, "-m", "lerobot_demohlm.cli", "generate", "--task", "LiftBox", "--region", "R1"),
        *("--seed", "3", "--num-attempts", str(num_attempts), "--num-workers", "2", "--root", str(tmp_path / "killed")),
    ]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    blocks = tmp_path / "killed.partial" / "blocks"
    deadline = time.monotonic() + 300
    while not list(blocks.glob("[0-9]*")):
        assert process.poll() is None, "it ended before its first block"
        assert time.monotonic() < deadline
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "killed").exists()
    finished = subprocess.run(command, capture_output=True, text=True, check=True)
    summary = json.loads(finished.stdout.splitlines()[-1])
    assert summary["attempts"] == num_attempts
    options = {"num_attempts": num_attempts, "block_size": BLOCK_SIZE, "num_workers": 2}
    whole = generate(request(tmp_path / "whole", **options))
    assert digest(tmp_path / "killed") == digest(tmp_path / "whole")
    assert summary["outcomes"] == whole.outcomes
    assert "attempt" in finished.stderr  # the progress bar


def test_wrong_requests_leave_nothing(tmp_path: Path) -> None:
    wrong: list[tuple[dict[str, object], type[Exception]]] = [
        ({"task": "LiftBoxes"}, UnknownNameError),
        ({"region": "R9"}, UnknownNameError),
        ({"num_workers": 0}, DatasetError),
        ({"num_attempts": None}, DatasetError),
        ({"num_episodes": 1}, DatasetError),
    ]
    for changes, error in wrong:
        with pytest.raises(error):
            generate(request(tmp_path / "data", **changes))
    assert list(tmp_path.iterdir()) == []
