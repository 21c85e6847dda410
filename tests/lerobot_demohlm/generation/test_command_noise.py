"""Command noise: bounded, drawn from seed and index alone, recorded without, and verified bit for bit all the same."""

import dataclasses
import itertools
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import get_task
from gym_demohlm.task import REGIONS
from lerobot_demohlm import cli
from lerobot_demohlm.checks import verify
from lerobot_demohlm.datasets import reader
from lerobot_demohlm.datasets.episode import Episode
from lerobot_demohlm.datasets.facts import GenerationFacts, read_facts
from lerobot_demohlm.datasets.variation import PLAIN, DataVariation
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.generation import command_noise, stages
from lerobot_demohlm.generation.attempt import Attempt, Attempts, initial_state
from lerobot_demohlm.generation.block import write_block
from lerobot_demohlm.generation.command_noise import DEVIATIONS, LARGEST, LONGEST, SHARES, SHORTEST, bursts, disturbed
from lerobot_demohlm.generation.request import GenerationRequest
from lerobot_demohlm.generation.run import GenerationRun
from lerobot_demohlm.generation.stages import Settings
from lerobot_demohlm.reports.explain import explain_attempt
from tests.helpers.synthetic import make_facts

TASK, REGION, SEED, SCALE = get_task("LiftBox"), "R1", 7, 1.0
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


def varied(**knobs: float) -> Settings:
    """Return settings whose attempts are plain but for these knobs."""
    return Settings(variation=DataVariation.read(knobs))


def make(indices: range, scale: float = SCALE) -> list[Episode]:
    attempts = Attempts(TASK, demonstrations.load(task=TASK), REGION, SEED, len(indices), varied(command_noise=scale))
    made = attempts.run(indices)
    attempts.close()
    return made


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    """Return three noisy attempts made side by side."""
    return make(range(3))


@pytest.fixture(scope="module")
def root(episodes: list[Episode], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of the first two of them, cut out of a block of three; not to be changed."""
    source = demonstrations.load(task=TASK).content_hash
    facts = make_facts(seed=SEED, num_attempts=None, num_episodes=2, block_size=3, command_noise=SCALE)
    facts = dataclasses.replace(facts, demonstration_hash=source)
    run = GenerationRun.open(tmp_path_factory.mktemp("noisy") / "data", "user/noisy", facts)
    for block in run.pending_blocks():
        write_block(run.directory, facts, block, episodes)
    run.finish()
    return run.root


def noise_of(seed: int, index: int, ticks: int = 400) -> np.ndarray:
    return np.stack(list(itertools.islice(bursts(seed, index), ticks)))


def test_noise_comes_in_bursts_with_pauses_and_depends_on_seed_and_index() -> None:
    noise = noise_of(3, 5)
    np.testing.assert_array_equal(noise, noise_of(3, 5))
    assert not np.array_equal(noise, noise_of(3, 6)) and not np.array_equal(noise, noise_of(4, 5))
    assert (np.abs(noise) <= LARGEST * DEVIATIONS).all()
    assert not noise[:, command.GRIPPERS].any()
    edges = np.flatnonzero(np.any(np.diff(noise, axis=0) != 0.0, axis=1)) + 1
    lengths = np.diff(edges)
    assert lengths.min() >= SHORTEST and lengths.max() <= LONGEST
    quiet = [not noise[edge].any() for edge in edges]
    assert all(a != b for a, b in itertools.pairwise(quiet))  # bursts and recoveries in turn
    spread = noise[noise.any(axis=1)].std(axis=0)
    assert (spread[:21] > 0.6 * DEVIATIONS[:21]).all()


def test_a_disturbed_command_is_one_that_a_dataset_can_hold() -> None:
    rng = np.random.default_rng(0)
    for planned in rng.uniform(command.LOWER, command.UPPER, size=(50, command.SIZE)).astype(np.float32):
        np.testing.assert_array_equal(disturbed(planned, np.zeros(command.SIZE)), planned)
        executed = disturbed(planned, 100.0 * DEVIATIONS)
        assert executed.dtype == np.float32
        assert (executed <= command.UPPER + 1e-6).all() and (executed >= planned).all()
    standing = command.rest().astype(np.float32)
    assert not disturbed(standing, DEVIATIONS)[command.VELOCITY].any()
    assert disturbed(standing, -DEVIATIONS)[command.HEIGHT] < standing[command.HEIGHT]


def test_executed_commands_differ_from_recorded_ones_within_bounds(episodes: list[Episode]) -> None:
    for episode in episodes:
        assert episode.outcome == "success" and episode.executed is not None
        carried = np.abs(episode.executed.astype(np.float64) - episode.action)
        stage = np.repeat(list(episode.stage_ticks), list(episode.stage_ticks.values()))
        for name, share in SHARES.items():
            assert (carried[stage == name] <= share * SCALE * LARGEST * DEVIATIONS + 1e-6).all()
            assert 0.1 < carried[stage == name].any(axis=1).mean() < 0.9
        standing = ~episode.action[:, command.VELOCITY].any(axis=1)
        assert not carried[standing][:, command.VELOCITY].any()
        touch = int(np.flatnonzero(stage == stages.MANIPULATION)[0])
        before, after = Settings().playback.delicate_ticks
        assert not carried[touch - before : touch + after].any()
        held = episode.action[-Settings().playback.final_ticks :]
        np.testing.assert_array_equal(held, np.broadcast_to(held[0], held.shape))  # what it holds is what was planned
        np.testing.assert_array_equal(held, episode.executed[-len(held) :])


def test_an_attempt_alone_has_the_same_bits_as_in_a_batch(episodes: list[Episode]) -> None:
    (alone,) = make(range(1, 2))
    assert alone.record() == episodes[1].record()  # with the digest of all its states
    assert alone.executed is not None
    np.testing.assert_array_equal(alone.executed, episodes[1].commands)


def test_noise_that_is_nothing_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    (plain,) = make(range(1), scale=0.0)
    monkeypatch.setattr(command_noise, "bursts", lambda _seed, _index: itertools.repeat(np.zeros(command.SIZE)))
    (noisy,) = make(range(1))
    assert plain.executed is None and plain.commands is plain.action
    assert noisy.record() == plain.record()
    np.testing.assert_array_equal(noisy.commands, plain.action)
    assert plain.labels().keys() == noisy.labels().keys() - {"executed"}


def test_a_noisy_dataset_is_verified_and_explained(root: Path, episodes: list[Episode]) -> None:
    found = reader.read(root, [0, 1])
    for entry, episode in zip(found, episodes, strict=False):
        np.testing.assert_array_equal(entry.columns["action"], episode.action)
        np.testing.assert_array_equal(entry.commands, episode.commands)
    assert verify.verify(root, TASK).identical
    assert read_facts(root)["command_noise"] == SCALE
    assert "| Command noise | 1.0:" in (root / "README.md").read_text()
    page, said = explain_attempt(root, 1, pictures=False)
    assert said["same_bits"]
    assert page.count(">executed</text>") == 4  # velocities and torso height
    assert "largest noise of a joint of each arm [deg]" in page


def test_executed_commands_that_are_tampered_with_are_found(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = root / EPISODES
    kept = path.read_bytes()
    try:
        table = pq.read_table(path)
        pq.write_table(table.drop_columns(["executed"]), path)  # as if actions had been executed
        (difference,) = verify.verify(root, TASK, [0]).differences
        entry = reader.read(root, [0])[0]
        assert difference.field in ("physics", "controller")
        path.write_bytes(kept)
        carried = (reader.read(root, [0])[0].commands != entry.columns["action"]).any(axis=1)
        assert difference.step == int(np.flatnonzero(carried)[0])
        cut = [content[:-4] for content in table.column("executed").to_pylist()]
        index = table.schema.get_field_index("executed")
        pq.write_table(table.set_column(index, "executed", [cut]), path)
        assert cli.main(["verify", "--root", str(root)]) == 2
        assert "executed commands of another length" in capsys.readouterr().err
    finally:
        path.write_bytes(kept)


def test_the_facts_of_a_run_say_how_its_data_is_varied(tmp_path: Path) -> None:
    chosen = {"command_noise": 0.5, "start_spread": 1.2, "stance_spread": 0.7, "retries": 1}
    facts = make_facts(**chosen)
    assert chosen.items() <= facts.content().items()  # flat on disk
    assert facts.variation == DataVariation.read(facts.content()) == DataVariation(**chosen)
    assert GenerationFacts.read(json.loads(json.dumps(facts.content()))) == facts
    assert DataVariation.read({"task": "LiftBox"}) == PLAIN  # an older run had no such knobs
    GenerationRun.open(tmp_path / "data", "user/name", facts).close()
    for changes in ({"command_noise": 0.0}, {"start_spread": 1.0}, {"stance_spread": 0.0}):
        with pytest.raises(DatasetError, match=next(iter(changes))):
            GenerationRun.open(tmp_path / "data", "user/name", make_facts(**{**chosen, **changes}))
    words = ["generate", "--task", "LiftBox", "--num-attempts", "1", "--root", str(tmp_path / "wrong")]
    wrong = {"--command-noise": ("-1", "nan"), "--start-spread": ("0.5",), "--stance-spread": ("-1",)}
    wrong["--retries"] = ("-1",)
    for option in [(name, value) for name, values in wrong.items() for value in values]:
        assert cli.main([*words, *option]) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data.partial"]


def test_the_defaults_have_one_source(monkeypatch: pytest.MonkeyPatch) -> None:
    """A request, settings, the command and the gallery take the same data where nobody says otherwise."""
    asked: list[GenerationRequest] = []
    monkeypatch.setattr("lerobot_demohlm.generation.runner.generate", asked.append)
    monkeypatch.setattr("lerobot_demohlm.cli.generate.summary_json", lambda _: {})
    assert cli.main(["generate", "--task", "LiftBox", "--num-attempts", "1", "--root", "data"]) == 0
    wanted = GenerationRequest(task="LiftBox", region="R3", seed=0, root=Path("data"), num_attempts=1)
    assert [dataclasses.asdict(request) for request in asked] == [dataclasses.asdict(wanted)]
    assert wanted.variation == Settings().variation == DataVariation()
    required = {entry.name for entry in dataclasses.fields(GenerationFacts) if entry.default is dataclasses.MISSING}
    assert required >= {"block_size", "keep_failures", "num_attempts", "num_episodes", "variation"}


def test_stances_are_off_by_what_they_may_be_and_the_same_again() -> None:
    drawn = np.array([stages.stance(3, index, 1.0) for index in range(500)])
    low, high = stages.STANCE_RANGES.T
    assert ((low <= drawn) & (drawn <= high)).all()
    np.testing.assert_allclose([drawn.min(axis=0), drawn.max(axis=0)], [low, high], atol=0.003)
    np.testing.assert_array_equal(stages.stance(3, 7, 1.0), drawn[7])
    np.testing.assert_allclose(stages.stance(3, 7, 0.5), 0.5 * drawn[7])
    assert not stages.stance(3, 7, 0.0).any()


def test_the_robot_acts_from_the_stance_that_was_drawn() -> None:
    """The goal of its walk is off by what was drawn, and there it stands when its hands begin."""
    seen: dict[float, tuple[np.ndarray, np.ndarray]] = {}
    for spread in (0.0, 1.0):

        def watch(attempt: Attempt, _: np.ndarray, spread: float = spread) -> None:
            if attempt.playback is not None and attempt.placement is not None:
                seen.setdefault(spread, (attempt.placement.goal, poses.to_planar(attempt.world.pose("pelvis"))))

        settings = varied(stance_spread=spread)
        attempts = Attempts(TASK, demonstrations.load(task=TASK), REGION, SEED, settings=settings, on_command=watch)
        attempts.run([0])
        attempts.close()
    (plain, _), (off, stood) = seen[0.0], seen[1.0]
    between = poses.invert(poses.planar(*plain)) @ poses.planar(*off)
    np.testing.assert_allclose(poses.to_planar(between), stages.stance(SEED, 0, 1.0), atol=1e-9)
    assert np.linalg.norm((stood - off)[:2]) < settings.locomotion.accept_m


def test_wider_starts_keep_the_objects_and_stay_as_far_from_them() -> None:
    region, wide = REGIONS["R3"], REGIONS["R3"].widened(1.5)
    assert region.widened(1.0) is region
    assert (wide.robot_x[1], wide.object_y, wide.object_yaw) == (region.robot_x[1], region.object_y, region.object_yaw)
    for name in ("robot_x", "robot_y", "robot_yaw"):
        assert np.ptp(getattr(wide, name)) == pytest.approx(1.5 * np.ptp(getattr(region, name)))
    pairs = [[initial_state(TASK, "R3", 0, index, spread) for spread in (1.0, 1.5)] for index in range(100)]
    assert all(plain["object"] == spread["object"] for plain, spread in pairs)
    robots = np.array([spread["robot"] for _, spread in pairs])
    assert robots[:, 0].min() < region.robot_x[0] and robots[:, 0].max() <= region.robot_x[1]
    assert np.abs(robots[:, 2]).max() > region.robot_yaw[1]
    assert json.dumps(pairs[0][0]) == json.dumps(initial_state(TASK, "R3", 0, 0))
