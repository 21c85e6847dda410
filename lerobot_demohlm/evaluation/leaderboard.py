"""A policy and a task -> its score under the fixed protocol of docs/benchmark.md: a result file with its hash, a card.

The protocol is data: what is measured depends on its version and the task alone. The result file says what was run and
what came of it, and ends with the SHA-256 of all that, so that a number that was changed by hand is found out.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gym_demohlm.errors import DatasetError
from gym_demohlm.files import replace_text
from gym_demohlm.registry import get_task
from lerobot_demohlm.evaluation.evaluate import evaluate, read_rollouts, success_rate, summarize
from lerobot_demohlm.evaluation.loaded_policy import LoadedPolicy
from lerobot_demohlm.evaluation.rollout import Rollout
from lerobot_demohlm.evaluation.rollouts import Setting
from lerobot_demohlm.evaluation.scoring import first_seed
from lerobot_demohlm.reproducibility import provenance
from lerobot_demohlm.reproducibility.results import commit

RESULT, CARD = "result.json", "README.md"


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """What a version of the benchmark measures.

    Attributes:
        version: Of the protocol; scores of different versions are not compared.
        cells: Pairs of region and variation.
        episodes: Rollouts in each.
        success: Which success counts.
    """

    version: int = 1
    cells: tuple[tuple[str, str], ...] = (("R3", "none"), ("R3", "real"), ("R4", "none"), ("R4", "real"))
    episodes: int = 100
    success: str = "success_strict"


PROTOCOL = Protocol()


def run(
    loaded: LoadedPolicy, task: str, output: Path, *, num_workers: int = 1, trial: int | None = None
) -> dict[str, Any]:
    """Measure a policy and write its result and its card; a call that was killed is resumed by the same call.

    Args:
        loaded: The policy.
        task: Name of the task.
        output: Directory of the result file, the card and the rollouts; made if missing.
        num_workers: Processes that roll out.
        trial: Rollouts in each cell instead of the protocol's; such a result is marked as none.

    Returns:
        The result.

    Raises:
        DatasetError: A result is there already, the rollouts are of another policy, or ``trial`` is out of range.
    """
    task, count = get_task(task).name, PROTOCOL.episodes if trial is None else trial
    if not 1 <= count <= PROTOCOL.episodes:
        raise DatasetError(f"trial={trial}", f"1 to {PROTOCOL.episodes} rollouts a cell", "correct --trial")
    if (output / RESULT).exists():
        raise DatasetError(f"{output / RESULT}, which exists", "a new directory", "choose another --output")
    output.mkdir(parents=True, exist_ok=True)
    cells = []
    for region, variation in PROTOCOL.cells:
        setting = Setting(task=task, region=region, variation=variation, num_workers=num_workers)
        seeds = range(first_seed(task, region), first_seed(task, region) + count)
        path = output / f"rollouts_{region.lower()}_{variation}.jsonl"
        rollouts = evaluate(loaded, setting, seeds, path)
        cells.append(_cell(region, variation, seeds.start, rollouts, path))
    result = sign(
        {
            "benchmark": "demohlm",
            "version": PROTOCOL.version,
            "protocol": json.loads(json.dumps(asdict(PROTOCOL))),
            "official": trial is None,
            "task": task,
            "policy": loaded.kind,
            "policy_hash": loaded.hash,
            "num_train_episodes": loaded.num_train_episodes,
            "starts": "scoring: seeds that no training, tuning, test or preset uses",
            "cells": cells,
            "score": _score(cells),
            "commit": commit(),
            "code_hash": provenance.simulation_hash(get_task(task)),
            "versions": provenance.bit_versions(),
        }
    )
    replace_text(output / CARD, card(result))
    replace_text(output / RESULT, json.dumps(result, indent=2) + "\n")
    return result


def _score(cells: Sequence[Mapping[str, Any]]) -> float:
    return round(sum(cell["successes"] for cell in cells) / sum(cell["episodes"] for cell in cells), 4)


def _cell(region: str, variation: str, seed: int, rollouts: Sequence[Rollout], path: Path) -> dict[str, Any]:
    return {
        "region": region,
        "variation": variation,
        "first_seed": seed,
        **_counts(rollouts),
        "rollouts_sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
    }


def _counts(rollouts: Sequence[Rollout]) -> dict[str, Any]:
    """Return what of a cell its rollouts say."""
    summary = summarize(rollouts)
    return {
        "episodes": len(rollouts),
        "successes": sum(bool(rollout.success_strict) for rollout in rollouts),
        **{name: summary[name] for name in ("success_strict", "success_held", "outcomes")},
    }


def sign(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result with the SHA-256 of its content."""
    return {**content, "sha256": _digest(content)}


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def read(path: Path) -> dict[str, Any]:
    """Read a result file and check that it is as it was written, and so its card and rollouts where they are beside it.

    Nobody can see who signed it: who edits a file can sign it again. So its numbers are checked against each other,
    and against the rollouts.

    Raises:
        DatasetError: It is missing, no result of this benchmark, of another version, was edited, or its numbers do not
            follow from each other, from the protocol or from the rollouts.
    """
    try:
        content = json.loads(Path(path).read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path} ({error})", f"a {RESULT} of `demohlm leaderboard`", "check the path") from error
    if not isinstance(content, dict) or content.get("benchmark") != "demohlm":
        raise DatasetError(f"{path}", f"a {RESULT} of `demohlm leaderboard`", "check the path")
    if content.get("version") != PROTOCOL.version:
        raise DatasetError(
            f"{path} of version {content.get('version')}", f"version {PROTOCOL.version}", "measure the policy again"
        )
    signed = content.pop("sha256", None)
    if signed != _digest(content):
        raise DatasetError(
            f"{path} with the hash {_digest(content)[:12]}",
            f"{str(signed)[:12]}, which it was written with: it was edited",
            "measure the policy again",
        )
    try:
        _require_consistent(Path(path), content)
        page, found = Path(path).with_name(CARD), card({**content, "sha256": signed})
        if page.exists() and page.read_text() != found:
            raise DatasetError(f"{page}, edited", "the card of the result", "measure the policy again")
    except (KeyError, TypeError, AttributeError, ZeroDivisionError) as error:
        raise DatasetError(f"{path}, damaged ({error!r})", "a result as it was written", "measure it again") from error
    return {**content, "sha256": signed}


def _require_consistent(path: Path, content: Mapping[str, Any]) -> None:
    """Raise ``DatasetError`` where numbers do not follow from each other, from the protocol or from the rollouts."""
    cells, protocol = content["cells"], json.loads(json.dumps(asdict(PROTOCOL)))
    counts = {cell["episodes"] for cell in cells}
    if [[cell["region"], cell["variation"]] for cell in cells] != protocol["cells"] or len(counts) != 1:
        raise DatasetError(f"{path} with other settings", "those of the protocol", "measure the policy again")
    if content["protocol"] != protocol or (content["official"] and counts != {PROTOCOL.episodes}):
        raise DatasetError(f"{path} with another protocol", f"version {PROTOCOL.version}", "measure the policy again")
    if content["score"] != _score(cells):
        raise DatasetError(
            f"{path} with the score {content['score']}", f"{_score(cells)}, by its cells", "measure the policy again"
        )
    get_task(content["task"])
    controllers = set()
    for cell in cells:
        if cell["first_seed"] != first_seed(content["task"], cell["region"]):
            raise DatasetError(f"{path} with other starts", "those of the protocol", "measure the policy again")
        successes, episodes = cell["successes"], cell["episodes"]
        fits = 0 <= successes <= episodes == sum(cell["outcomes"].values())
        if not fits or cell["success_strict"] != success_rate(successes, episodes):
            raise DatasetError(
                f"{path} with a rate of {cell['success_strict']['rate']} in {cell['region']}, {cell['variation']}",
                f"what follows from {successes} successes and one outcome for each of {episodes} rollouts",
                "measure the policy again",
            )
        file = path.parent / f"rollouts_{cell['region'].lower()}_{cell['variation']}.jsonl"
        if not file.exists():
            continue
        if hashlib.sha256(file.read_bytes()).hexdigest() != cell["rollouts_sha256"]:
            raise DatasetError(f"{file}, edited", "the rollouts of the result", "measure the policy again")
        found = read_rollouts(file)
        wrong = [name for name, value in _counts(found).items() if json.loads(json.dumps(value)) != cell[name]]
        begin = cell["first_seed"]
        if sorted(rollout.seed for rollout in found) != list(range(begin, begin + cell["episodes"])):
            wrong.append("first_seed")
        said = {name: content[name] for name in ("task", "policy", "policy_hash")}
        said |= {"region": cell["region"], "variation": cell["variation"], "perception": "exact"}
        said["code"] = content["code_hash"]
        wrong += [name for name, value in said.items() if {getattr(rollout, name) for rollout in found} != {value}]
        controllers |= {rollout.controller for rollout in found}
        if len(controllers) > 1:
            wrong.append("controller")
        if wrong:
            raise DatasetError(f"{path} with another {wrong[0]} than {file.name}", "the same", "measure it again")


def card(result: Mapping[str, Any]) -> str:
    """Return a result as a page in Markdown."""
    lines = [
        f"# {result['task']}: {result['policy']}, {100 * result['score']:.1f} %",
        "",
        f"DemoHLM benchmark, version {result['version']}. Strict success over {len(result['cells'])} settings, from "
        "starts that no training, tuning, test or preset uses.",
    ]
    if not result["official"]:
        lines += ["", "**A trial, with fewer rollouts than the protocol asks for: no result.**"]
    lines += [
        "",
        "| region | variation | rollouts | strict success [%] | 95 % interval | held success [%] | other outcomes |",
        "|---|---|---|---|---|---|---|",
    ]
    for cell in result["cells"]:
        strict, held = cell["success_strict"], cell["success_held"]
        low, high = (100 * end for end in strict["interval"])
        others = ", ".join(f"{count} {name}" for name, count in cell["outcomes"].items() if count and name != "success")
        lines.append(
            f"| {cell['region']} | {cell['variation']} | {cell['episodes']} | {100 * strict['rate']:.1f} | "
            f"{low:.1f} to {high:.1f} | {100 * held['rate']:.1f} | {others or 'none'} |"
        )
    trained = result["num_train_episodes"]
    lines += [
        "",
        f"- policy: `{result['policy_hash']}`" + (f", trained on {trained} episodes" if trained else ""),
        f"- code: commit `{result['commit']}`, `{result['code_hash'][:12]}`",
        f"- hash of the result: `{result['sha256']}`",
        "",
    ]
    return "\n".join(lines)
