"""Experiments: the order of the cells, running and resuming them."""

import dataclasses
import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_demohlm.errors import DatasetError, PolicyError, UnknownNameError
from gym_demohlm.perception.error_model import fitted_path, read_model
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.task import SCORING_SEEDS
from gym_demohlm.variation.factors import GROUPS
from lerobot_demohlm import cli
from lerobot_demohlm.checks import portability
from lerobot_demohlm.datasets.facts import write_facts
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.experiments import cells as cells_module
from lerobot_demohlm.experiments import lines
from lerobot_demohlm.experiments import plan as plan_module
from lerobot_demohlm.experiments.cells import Effort, run_cell
from lerobot_demohlm.experiments.cells import _alone as run_alone
from lerobot_demohlm.experiments.lines import GenerationResult, PolicyResult
from lerobot_demohlm.experiments.plan import PERCEPTIONS, STRENGTHS, Cell, RegionCell, plan
from lerobot_demohlm.experiments.reproduce import missing, reproduce
from lerobot_demohlm.experiments.variants import DEFAULT_VARIANT, sight_stamp, stamp
from lerobot_demohlm.generation.attempt import initial_state
from lerobot_demohlm.generation.block import write_block
from lerobot_demohlm.generation.request import GenerationRequest
from lerobot_demohlm.generation.run import GenerationRun
from tests.helpers.experiment_lines import CELL, layout, make_line
from tests.helpers.synthetic import make_episode, make_facts


def fake_run(cell: Cell | RegionCell) -> PolicyResult | None:
    """Stand in for what runs a cell, in another process."""
    if cell.task == "PushCube":
        raise DatasetError("no success", "some", "try again")
    if cell.task == "Handover":
        raise ValueError("torch has something against it")
    if cell.task == "GraspCube":
        os._exit(9)  # as one that is killed for its memory
    return None if cell.task == "PressCube" or not isinstance(cell, Cell) else make_line(cell)


def test_cells_whose_worlds_do_not_vary_are_those_of_the_plain_world() -> None:
    for table in ("worlds", "regions"):
        assert plan(table, variations=("real@0", "none:pushes")) == plan(table, variations=("none",))


def test_every_task_has_a_number_before_any_has_two() -> None:
    cells = plan("main")
    tasks = list(all_tasks())
    for start in range(0, len(cells), len(tasks)):
        assert [cell.task for cell in cells[start : start + len(tasks)]] == tasks
    assert len(set(cells)) == len(cells) == 5 * len(tasks)
    rounds = [
        (c.policy, c.num_train_episodes, c.train_seed) for c in cells if isinstance(c, Cell) and c.task == tasks[0]
    ]
    assert rounds == [("mlp", 1000, 0), ("mlp", 100, 0), ("act", 1000, 0), ("mlp", 1000, 1), ("mlp", 100, 1)]
    assert {cell.policy for cell in plan("architectures", tasks=["LiftBox"])} == {"mlp", "act", "diffusion"}  # pyright: ignore
    regions = [(cell.region, cell.variation) for cell in plan("regions", tasks=["LiftBox"])]
    assert regions == [(region, world) for world in ("none", "real") for region in ("R3", "R2", "R1", "R4")]
    assert len(plan("main", tasks=["LiftBox"], sizes=[5000], seeds=[3], policies=["mlp"])) == 1
    with pytest.raises(UnknownNameError, match="task 'Lift'"):
        plan("main", tasks=["Lift"])
    with pytest.raises(PolicyError, match="num_train_episodes=0"):
        plan("main", sizes=[0])


def test_harder_worlds_have_tables_of_their_own() -> None:
    worlds = plan("worlds", tasks=["LiftBox"], policies=["mlp"], seeds=[0])
    assert [(c.region, c.variant, c.variation) for c in worlds if isinstance(c, Cell)] == [
        ("R3", "real", "real"), ("R3", "noise", "real"), ("R4", "real", "real"), ("R4", "noise", "real")
    ]  # fmt: skip
    seen = plan("perception", tasks=["LiftBox"], policies=["mlp"], variants=["noise"])
    assert [c.perception for c in seen if isinstance(c, Cell)] == list(PERCEPTIONS)
    grey = plan("perception", tasks=["PourWater"], policies=["mlp"], variants=["noise"])
    assert {c.perception for c in grey if isinstance(c, Cell)} == set(PERCEPTIONS) - {"rgbd,masks=color"}
    graded = plan("robustness", tasks=["LiftBox"])
    assert len(graded) == 1 + len(GROUPS) * len(STRENGTHS) and graded[1].variation == "hard@0.5:objects"
    wrong: list[tuple[str, dict[str, Any]]] = [
        ("worlds", {"variations": ["reel"]}),
        ("worlds", {"perceptions": ["eyes"]}),
        ("worlds", {"regions": ["R9"]}),
        ("regions", {"variations": ["reel"]}),
        ("regions", {"regions": ["R9"]}),
    ]
    for table, chosen in wrong:
        with pytest.raises(UnknownNameError):
            plan(table, **chosen)


def test_cells_that_differ_in_their_rollouts_only_share_a_training(tmp_path: Path) -> None:
    own = layout(tmp_path)
    cells = [
        CELL,
        *(dataclasses.replace(CELL, variation=name) for name in ("real", "hard@0.5:objects", "hard@1:robot")),
    ]
    cells += [dataclasses.replace(CELL, perception=name) for name in ("rgbd", "rgbd,masks=color")]
    assert {own.training(cell) for cell in cells} == {own.training(CELL)}
    assert len({own.rollouts(cell) for cell in cells}) == len(cells)
    assert all(set(own.rollouts(cell).name) <= set("abcdefghijklmnopqrstuvwxyz0123456789._-") for cell in cells)
    real = dataclasses.replace(CELL, variant="real")
    assert own.training(real) != own.training(CELL)
    assert own.dataset("LiftBox", "R3", 100, "real") != own.dataset("LiftBox", "R3", 100, "noise")
    for cell in (*cells, real):
        line = make_line(cell)
        assert [other for other in (*cells, real) if other.is_of(line)] == [cell]


def test_a_stamp_knows_the_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    real = dataclasses.replace(CELL, variation="real")
    before = real.stamp, CELL.stamp
    assert before[0].startswith(CELL.stamp) and real.data_stamp == CELL.stamp
    assert dataclasses.replace(CELL, variation="real:robot", variant="real").stamp == real.stamp
    stamp.cache_clear()
    monkeypatch.setattr(portability, "recipe", lambda preset: f"new {preset}")
    assert real.stamp != before[0] and CELL.stamp == before[1]
    stamp.cache_clear()


def test_smaller_sizes_come_from_the_larger_dataset(tmp_path: Path) -> None:
    own = layout(tmp_path)
    first = own.dataset("LiftBox", "R3", 1000)
    first.mkdir(parents=True)
    assert own.dataset("LiftBox", "R3", 100) == own.dataset("LiftBox", "R3", 1000) == first
    assert own.dataset("LiftBox", "R3", 1001) != first
    assert own.dataset("LiftBox", "R2", 100) != first
    own.dataset("LiftBox", "R3", 5000).mkdir()
    assert own.dataset("LiftBox", "R3", 100) == first


def test_a_region_whose_line_was_never_written_is_not_made_again(tmp_path: Path) -> None:
    own, cell = layout(tmp_path), RegionCell(task="LiftBox", region="R2")
    root = own.generation(cell, 4)
    (root / "meta").mkdir(parents=True)
    outcomes = ["success", "fell", "success", "success"]
    write_facts(root, make_facts(), [make_episode(i, outcome=outcome).record() for i, outcome in enumerate(outcomes)])
    line = run_cell(cell, own, Effort(num_attempts=4, deadline=0.0))
    assert isinstance(line, GenerationResult) and cell.is_of(line)
    assert (line.attempts, line.successes, line.outcomes["fell"]) == (4, 3, 1)
    assert line.episode_s == pytest.approx(1.2)
    assert run_cell(cell, own, Effort(num_attempts=5, deadline=0.0)) is None, "there are not so many, and no time"


def test_data_and_attempts_are_made_by_as_many_processes_as_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[GenerationRequest] = []

    def note(request: GenerationRequest) -> None:
        asked.append(request)
        raise DatasetError("no success", "some", "try again")

    monkeypatch.setattr(cells_module, "generate", note)
    for cell in (CELL, RegionCell(task="LiftBox", region="R2")):
        for effort in (Effort(), Effort(data_workers=3)):
            with pytest.raises(DatasetError, match="no success"):
                run_cell(cell, layout(tmp_path), effort)
    assert [request.num_workers for request in asked] == [1, 3, 1, 3]
    assert asked[0] == dataclasses.replace(asked[1], num_workers=1), "nothing else differs"


def test_starts_are_kept_for_scoring_and_no_two_cells_share_them() -> None:
    regions = plan("regions", variations=["none"])
    assert all(cell.seed in SCORING_SEEDS for cell in regions if isinstance(cell, RegionCell))
    starts = [initial_state(get_task(c.task).at(c.region), c.region, SCORING_SEEDS.start, 0)["robot"] for c in regions]
    assert len(set(map(tuple, starts))) == len(regions) == 4 * len(all_tasks())
    seeds = [
        cell.first_seed
        for cell in plan("worlds", policies=["mlp"], variants=["real"], seeds=[0])
        if isinstance(cell, Cell)
    ]
    with pytest.raises(DatasetError, match="at most 1000"):
        Effort(num_rollouts=1001)
    assert len(set(seeds)) == len(seeds) and all(seed in SCORING_SEEDS for seed in seeds)


def test_what_is_missing_is_run_and_the_rest_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = layout(tmp_path)
    tasks = ["LiftBox", "PressCube", "PushCube"]
    cells = plan("main", tasks=[*tasks, "Handover", "GraspCube"], sizes=[100], seeds=[0], policies=["mlp"])
    cells += plan("main", tasks=tasks, sizes=[100], seeds=[1], policies=["mlp"])
    done, failures = reproduce(cells, own, fake_run, num_workers=2, command="demohlm reproduce ...")
    assert done == 2
    assert sorted(failure.partition("_mlp")[0] for failure in failures) == [
        "grasp_cube",
        "handover",
        "push_cube",
        "push_cube",
    ]
    texts = "\n".join(failures)
    assert "no success" in texts and "ValueError: torch has something" in texts and "BrokenProcessPool" in texts
    cells = plan("main", tasks=tasks, sizes=[100], seeds=[0, 1], policies=["mlp"])
    kept = lines.read_policies(own.policies_file)
    assert sorted(line.train_seed for line in kept) == [0, 1]
    assert {(line.task, line.command) for line in kept} == {("LiftBox", "demohlm reproduce ...")}
    assert [cell.task for cell in missing(cells, own)] == ["PressCube", "PushCube"] * 2
    assert reproduce(cells[:1], own, fake_run) == (0, [])
    assert reproduce(missing(cells, own), own, fake_run, deadline=time.monotonic()) == (0, [])
    lines.append(own.policies_file, "another robot", make_line(CELL, stamp="other"))
    assert CELL not in missing([CELL], own)
    assert missing([CELL], own, num_rollouts=251) == [CELL]
    capsys.readouterr()
    words = ["reproduce", "--table", "main", "--tasks", *tasks, "--sizes", "100", "--policies", "mlp", "--seeds", "0"]
    folders = ["--root", str(own.root), "--results", str(own.results)]
    assert cli.main([*words, *folders, "--dry-run"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2
    assert cli.main([*words, *folders, "--budget-hours", "0"]) == 2
    assert cli.main([*words, *folders, "--budget-hours", "1e-9"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["missing"] == 2


def test_a_recipe_tells_how_ranges_are_measured_where_they_count(monkeypatch: pytest.MonkeyPatch) -> None:
    cells = [dataclasses.replace(CELL, policy=policy) for policy in ("mlp", "act", "diffusion")]
    before = [cell.recipe for cell in cells]
    monkeypatch.setattr(plan_module, "RANGE_FLOOR", 1.0)
    assert [cell.recipe == old for cell, old in zip(cells, before, strict=True)] == [True, True, False]


@pytest.mark.parametrize(
    "changes",
    [
        {"stamp": "other"},
        {"recipe": "other"},
        {"steps": 2},
        {"variant": "plain"},
        {"train_seed": 1},
        {"episodes": 2},
        {"first_seed": 0},
    ],
    ids=str,
)
def test_a_line_of_something_else_is_not_a_cells(tmp_path: Path, changes: dict[str, Any]) -> None:
    own = layout(tmp_path)
    lines.append(own.policies_file, "demohlm reproduce", make_line(CELL, **changes))
    assert missing([CELL], own, num_rollouts=250) == [CELL]
    lines.append(own.policies_file, "demohlm reproduce", make_line(CELL))
    assert missing([CELL], own, num_rollouts=250) == []


def test_regions_are_of_plain_attempts_and_enough_of_them(tmp_path: Path) -> None:
    own, cell = layout(tmp_path), RegionCell(task="LiftBox", region="R3")
    line = GenerationResult(**dataclasses.asdict(cell), stamp=cell.stamp, attempts=500, successes=500)
    changed = ({"command_noise": 1.0}, {"start_spread": 1.3}, {"retries": 1}, {"stamp": "other"}, {"attempts": 3})
    for changes in (*changed, {"perception": "rgbd"}, {"variation": "real"}, {"seed": 0}):
        lines.append(own.generation_file, "demohlm generate", dataclasses.replace(line, **changes))
    assert missing([cell], own, num_attempts=500) == [cell]
    lines.append(own.generation_file, "demohlm generate", line)
    assert missing([cell], own, num_attempts=500) == []


def test_a_stamp_is_of_what_generation_does(monkeypatch: pytest.MonkeyPatch) -> None:
    known = portability.packaged()
    assert stamp("LiftBox") == known["tasks"]["LiftBox"][:8]
    unknown = {**known, "tasks": {}}
    monkeypatch.setattr(portability, "packaged", lambda: unknown)
    task = get_task("PressCube")
    found = portability.stamp(task)
    assert found == portability.behaviour(task)[:8]
    harder = dataclasses.replace(task, name="HarderPress", success=lambda sim: task.success(sim) & False)
    monkeypatch.setattr(portability, "get_task", {"HarderPress": harder}.__getitem__)
    recorded = demonstrations.load(None, task)
    monkeypatch.setattr(portability.demonstrations, "load", lambda *_: recorded)
    assert portability.stamp(harder) != found, "another condition of success is another behaviour"


@pytest.mark.parametrize(
    ("worlds", "fitted"),
    [
        ([("none", "exact"), ("none", "rgbd,masks=color")], False),
        ([("none", "exact"), ("none", "model")], True),
        ([("none", "model"), ("none", "exact")], True),
        ([("real", "exact"), ("none", "exact")], True),
        ([("none", "exact"), ("hard:objects", "exact")], False),
    ],
)
def test_what_is_seen_by_a_fit_is_of_an_earlier_version_once_that_changes(
    worlds: list[tuple[str, str]], fitted: bool
) -> None:
    letters = read_model(fitted_path(get_task("LiftBox")), get_task("LiftBox")).hash[:8] if fitted else ""
    assert sight_stamp("LiftBox", *worlds) == stamp("LiftBox", *(variation for variation, _ in worlds)) + letters


def test_a_training_has_a_place_of_its_own_by_its_steps(tmp_path: Path) -> None:
    own, trial = layout(tmp_path), dataclasses.replace(CELL, steps=2)
    assert own.training(trial) != own.training(CELL)
    assert own.rollouts(trial) != own.rollouts(CELL)
    assert plan("main", tasks=["LiftBox"], sizes=[100], seeds=[0], policies=["mlp"], steps=2) == [trial]
    assert plan("main", tasks=["LiftBox"] * 2, sizes=[100] * 2, seeds=[0, 0], policies=["mlp"]) == [CELL]


def test_two_at_one_cell_are_told_so(tmp_path: Path) -> None:
    own = layout(tmp_path)
    own.training(CELL).parent.mkdir(parents=True)
    with run_alone(own.training(CELL)), pytest.raises(DatasetError, match="is at work"):
        run_cell(CELL, own, Effort(deadline=0.0))
    assert run_cell(CELL, own, Effort(deadline=0.0)) is None, "the time is up, and nobody holds it"


def test_a_lock_is_never_held_twice_and_fails_in_no_other_way(tmp_path: Path) -> None:
    held, most, refused = [], [], []

    def take(_: int) -> None:
        for _ in range(50):
            try:
                with run_alone(tmp_path / "cell"):
                    held.append(1)
                    time.sleep(0.001)  # so that the others try meanwhile
                    most.append(len(held))
                    held.pop()
            except DatasetError:
                refused.append(1)
                time.sleep(0.0002)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(take, range(4)))
    assert set(most) == {1} and refused


def test_a_region_in_which_nothing_succeeds_has_a_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(request: GenerationRequest) -> None:
        run = GenerationRun.open(request.root, "local/none", make_facts(num_attempts=1))
        write_block(run.directory, run.facts, range(1), [make_episode(0, outcome="fell")])
        run.finish()

    monkeypatch.setattr(cells_module, "generate", fail)
    result = run_cell(RegionCell(task="LiftBox", region="R2"), layout(tmp_path), Effort(num_attempts=1))
    assert isinstance(result, GenerationResult)
    assert (result.attempts, result.successes, result.success_rate, result.episode_s) == (1, 0, 0.0, None)


def process_of(cell: Cell) -> PolicyResult:
    """Stand in for what runs a cell."""
    return make_line(cell, first_seed=os.getpid())


def test_each_cell_has_a_process_of_its_own(tmp_path: Path) -> None:
    own, run = layout(tmp_path), process_of
    wanted = plan("main", tasks=["LiftBox"], sizes=[100], seeds=[0, 1], policies=["mlp"])
    assert reproduce(wanted, own, run) == (2, [])  # pyright: ignore[reportArgumentType]
    assert len({line.first_seed for line in lines.read_policies(own.policies_file)} | {os.getpid()}) == 3


def run_beside(cell: Cell, folder: Path, seconds: float) -> PolicyResult:
    """Stand in for what runs a cell, and wait so long for another beside it."""
    (folder / f"seed{cell.train_seed}").touch()
    end = time.monotonic() + seconds
    while (began := len(list(folder.glob("seed*")))) < 2 and time.monotonic() < end:
        time.sleep(0.01)
    return make_line(cell, first_seed=began)


@pytest.mark.parametrize("made", [False, True])
def test_one_cell_makes_the_data_of_both(tmp_path: Path, made: bool) -> None:
    own, cells = layout(tmp_path), plan("main", tasks=["LiftBox"], sizes=[100], seeds=[0, 1], policies=["mlp"])
    if made:
        own.dataset("LiftBox", "R3", 1000, DEFAULT_VARIANT).mkdir(parents=True)
    run: Any = partial(run_beside, folder=tmp_path, seconds=60.0 if made else 2.0)
    assert reproduce(cells, own, run, num_workers=2) == (2, [])
    assert [line.first_seed for line in lines.read_policies(own.policies_file)] == [2 if made else 1, 2]


def test_two_cells_of_one_training_do_not_train_beside_each_other(tmp_path: Path) -> None:
    own = layout(tmp_path)
    cells = [CELL, dataclasses.replace(CELL, variation="real")]
    own.dataset(CELL.task, CELL.region, CELL.num_train_episodes, CELL.variant).mkdir(parents=True)
    run: Any = partial(run_beside, folder=tmp_path, seconds=2.0)
    assert reproduce(cells, own, run, num_workers=2) == (2, [])
    assert [line.first_seed for line in lines.read_policies(own.policies_file)] == [1, 1], "both are of one seed"


@pytest.mark.slow
def test_a_table_from_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["reproduce", "--table", "main", "--tasks", "LiftBox", "--sizes", "2", "1", "--seeds", "0", "--steps", "2"]
    words += ["--policies", "mlp", "--num-rollouts", "2", "--root", str(tmp_path / "runs")]
    words += ["--results", str(tmp_path / "results")]
    assert cli.main(words) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["run"] == 2
    kept = lines.read_policies(tmp_path / "results/experiments.jsonl")
    assert [line.num_train_episodes for line in kept] == [2, 1]
    assert [line.episodes for line in kept] == [2, 2]
    assert len(list((tmp_path / "runs/data").iterdir())) == 1
    assert np.isfinite([line.train_samples_per_s for line in kept]).all()
    assert cli.main(words) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == {
        "table": "main",
        "run": 0,
        "missing": 0,
        "failed": [],
    }
    assert lines.read_policies(tmp_path / "results/experiments.jsonl") == kept


def test_results_in_r4_say_how_attempts_keep_clear(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of tables, where worlds vary and have some; of shoulders, where there is none; elsewhere the letters stay."""
    near = stamp("LiftBox", "real")
    assert stamp("LiftBox", "real", region="R4") == near + portability.table_recipe()
    assert stamp("LiftBox", "none", region="R4") == stamp("LiftBox")
    for world in ("none", "real"):
        assert stamp("PushCart", world, region="R4") == stamp("PushCart", world) + portability.shoulder_recipe()
    handed = portability.table_recipe() + portability.handing_over_recipe()
    assert stamp("Handover", "real", region="R4") == stamp("Handover", "real") + handed
    stamp.cache_clear()
    monkeypatch.setattr(portability, "table_recipe", lambda: "another!")
    assert stamp("LiftBox", "real", region="R4") == near + "another!" and stamp("LiftBox", "real") == near
    stamp.cache_clear()
