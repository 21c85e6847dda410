"""The leaderboard: fixed starts, a result that shows when it was edited, and a card."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from gym_demohlm import jsonl
from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import all_tasks, get_task, register_task
from gym_demohlm.task import SCORING_SEEDS
from lerobot_demohlm.cli import main
from lerobot_demohlm.evaluation import leaderboard
from lerobot_demohlm.evaluation.evaluate import FIRST_SEED, read_rollouts, success_rate
from lerobot_demohlm.evaluation.leaderboard import PROTOCOL, card, read, sign
from lerobot_demohlm.evaluation.rollout import Rollout
from lerobot_demohlm.evaluation.scoring import first_seed
from lerobot_demohlm.experiments.rates import number
from tests.helpers.checkpoints import save_policy
from tests.helpers.paths import REPOSITORY


def result(**changes: Any) -> dict[str, Any]:
    success = success_rate(1, 2)
    cells = [
        {
            "region": region, "variation": variation, "episodes": 2, "successes": 1,
            "first_seed": first_seed("LiftBox", region),
            "success_strict": success, "success_held": success, "outcomes": {"success": 1, "fell": 1},
            "rollouts_sha256": "0" * 64,
        }
        for region, variation in PROTOCOL.cells
    ]  # fmt: skip
    content = {
        "benchmark": "demohlm", "version": 1, "official": False, "task": "LiftBox",
        "protocol": json.loads(json.dumps(asdict(PROTOCOL))), "policy": "act", "score": 0.5,
        "policy_hash": "a", "num_train_episodes": 3, "cells": cells, "commit": "c", "code_hash": "d",
    }  # fmt: skip
    return sign(content | changes)


def written(path: Path, content: dict[str, Any]) -> Path:
    path.write_text(json.dumps(content))
    return path


def test_a_result_reads_back_and_has_a_card(tmp_path: Path) -> None:
    found = read(written(tmp_path / "result.json", result()))
    assert found == result()
    page = card(found)
    assert "LiftBox: act, 50.0 %" in page and page.count("| R4 |") == 2 and "1 fell" in page
    assert "no result" in page and "no result" not in card(result(official=True))


@pytest.mark.parametrize("key", ["score", "policy_hash", "official"])
def test_an_edited_result_is_found_out(tmp_path: Path, key: str) -> None:
    with pytest.raises(DatasetError, match="it was edited"):
        read(written(tmp_path / "result.json", result() | {key: 1.0}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"score": 1.0}, "with the score 1.0; expected 0.5"),
        ({"official": True}, "another protocol"),
        ({"protocol": {"episodes": 2}}, "another protocol"),
        ({"cells": result()["cells"][:2]}, "other settings"),
        ({"cells": [{**cell, "first_seed": 1} for cell in result()["cells"]]}, "other starts"),
        ({"cells": [{**cell, "successes": 3} for cell in result()["cells"]], "score": 1.5}, "3 successes"),
        ({"cells": [{**cell, "success_strict": success_rate(2, 2)} for cell in result()["cells"]]}, "a rate of 1.0"),
        ({"cells": [{**cell, "outcomes": {"success": 1}} for cell in result()["cells"]]}, "one outcome for each of 2"),
        ({"cells": [{"region": "R3"}]}, "damaged"),
        ({"cells": 3}, "damaged"),
    ],
)
def test_a_result_that_was_edited_and_signed_again_must_still_add_up(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(DatasetError, match=message):
        read(written(tmp_path / "result.json", result(**changes)))


def test_edited_rollouts_are_found_out(tmp_path: Path) -> None:
    path = written(tmp_path / "result.json", result())
    (tmp_path / "rollouts_r4_real.jsonl").write_text("{}\n")
    with pytest.raises(DatasetError, match=r"rollouts_r4_real\.jsonl, edited"):
        read(path)


def rolled_out(folder: Path, **changes: str) -> Path:
    """Write a result of two rollouts a setting; those of the last setting are changed. Everything is signed."""
    cells = []
    for region, variation in PROTOCOL.cells:
        seed, last = first_seed("LiftBox", region), (region, variation) == PROTOCOL.cells[-1]
        rollout = Rollout(
            task="LiftBox", policy="act", policy_hash="a", region=region, variation=variation, seed=seed, code="d",
            controller="c", success_ever=True, success_end=True, success_held=True, success_strict=True,
            outcome="success", length_s=1.0, initial_state={},
        )  # fmt: skip
        rollouts = [replace(rollout, seed=each, **(changes if last else {})) for each in (seed, seed + 1)]
        path = folder / f"rollouts_{region.lower()}_{variation}.jsonl"
        jsonl.write(path, map(asdict, rollouts))
        cells.append(leaderboard._cell(region, variation, seed, rollouts, path))
    return written(folder / "result.json", result(cells=cells, score=1.0))


def test_rollouts_beside_a_result_are_those_of_its_settings(tmp_path: Path) -> None:
    assert read(rolled_out(tmp_path))["score"] == 1.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("task", "GraspCube"), ("policy", "mlp"), ("policy_hash", "b"), ("region", "R1"), ("variation", "none"),
        ("perception", "rgbd"), ("code", "e"), ("code", ""), ("controller", "another"),
    ],
)  # fmt: skip
def test_rollouts_of_something_else_are_found_out(name: str, value: str, tmp_path: Path) -> None:
    """Even where all was signed again: both variations of a region have the same seeds."""
    path = rolled_out(tmp_path, **{name: value})
    with pytest.raises(DatasetError, match=rf"another {name} than rollouts_r4_real\.jsonl"):
        read(path)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"benchmark": "demohlm", "version": 2}'])
def test_what_is_no_result_is_refused(tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "result.json"
    path.write_text(text)
    assert main(["leaderboard", "--check", str(path)]) == 2
    assert "expected" in capsys.readouterr().err


def test_a_policy_needs_its_task(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["leaderboard", "--policy", str(tmp_path)]) == 2
    assert "give one of the two" in capsys.readouterr().err


def test_scoring_starts_are_nobody_elses() -> None:
    firsts = [first_seed(name, region) for name in all_tasks() for region in ("R3", "R4")]
    assert len(set(firsts)) == len(firsts)
    assert all(first in SCORING_SEEDS and first + 999 in SCORING_SEEDS for first in firsts)
    assert FIRST_SEED not in SCORING_SEEDS


def test_a_result_is_not_written_over(tmp_path: Path) -> None:
    written(tmp_path / "result.json", result())
    with pytest.raises(DatasetError, match="which exists"):
        leaderboard.run(None, "LiftBox", tmp_path)  # pyright: ignore[reportArgumentType]  it is not looked at


def test_a_trial_goes_the_whole_way(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Four settings are rolled out, signed and checked; a call that was killed before the result ends in the same."""
    patience = replace(
        get_task("LiftBox"), name="Patience", episode_length_s=1.5, success=lambda sim: sim.time > 0.3, failures={}
    )
    register_task(patience)
    policy, output = save_policy(tmp_path / "policy"), tmp_path / "board"
    call = ["leaderboard", "--policy", str(policy), "--task", "Patience", "--trial", "2", "--output", str(output)]
    assert main(call) == 0
    printed = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (printed["score"], printed["official"]) == (1.0, False)  # who stands still succeeds, strictly too
    found = read(output / "result.json")
    assert [(cell["region"], cell["variation"]) for cell in found["cells"]] == list(PROTOCOL.cells)
    assert all(cell["episodes"] == cell["successes"] == 2 for cell in found["cells"])
    for cell in found["cells"]:
        path = output / f"rollouts_{cell['region'].lower()}_{cell['variation']}.jsonl"
        seeds = [rollout.seed for rollout in read_rollouts(path)]
        assert seeds == [first_seed("Patience", cell["region"]), first_seed("Patience", cell["region"]) + 1]
    assert "A trial" in (output / "README.md").read_text()
    assert main(["leaderboard", "--check", str(output / "result.json")]) == 0
    assert main(call) == 2 and "which exists" in capsys.readouterr().err
    for name, changes in (
        ("successes", {"successes": 1, "success_strict": success_rate(1, 2)}),
        ("episodes", {"episodes": 3, "success_strict": success_rate(2, 3), "outcomes": {"success": 2, "fell": 1}}),
        ("outcomes", {"outcomes": {"success": 1, "fell": 1}}),
    ):
        cells = [{**cell, **changes} for cell in found["cells"]]
        told = {key: content for key, content in found.items() if key != "sha256"} | {"cells": cells}
        told["score"] = 0.5 if name == "successes" else round(2 / told["cells"][0]["episodes"], 4)
        edited = output / "edited.json"
        with pytest.raises(DatasetError, match=f"another {name} than rollouts_r3_none"):
            read(written(edited, sign(told)))
    (output / "result.json").unlink()
    with (output / "rollouts_r4_real.jsonl").open("r+") as file:
        file.truncate(len(file.readline()))  # as if killed between the last two rollouts
    assert main(call) == 0 and read(output / "result.json")["cells"] == found["cells"]


def test_published_results_are_as_they_were_written() -> None:
    page = (REPOSITORY / "docs/benchmark.md").read_text()
    found = sorted((REPOSITORY / "results/leaderboard").glob("*/result.json"))
    assert found
    for path in found:
        content = read(path)
        assert content["official"]
        assert path.with_name("README.md").read_text() == card(content)
        shares = [*(cell["success_strict"]["rate"] for cell in content["cells"]), content["score"]]
        assert f"| {' | '.join(number(100 * share) for share in shares)} |" in page
