"""Scores of policies in worlds that vary by one group of factors, at three strengths -> a table and a figure."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from gym_demohlm import jsonl
from gym_demohlm.variation.factors import GROUPS
from lerobot_demohlm.evaluation.evaluate import wilson
from lerobot_demohlm.experiments.lines import PolicyResult
from lerobot_demohlm.experiments.plan import GRADED, STRENGTHS, graded
from lerobot_demohlm.experiments.rates import age, latest, markdown, method_title, steps_title
from lerobot_demohlm.experiments.success_curves import Panel, Point, draw_panels

SUCCESS = "success_strict"


@dataclass(frozen=True, kw_only=True)
class Row:
    """What is known of one policy.

    Attributes:
        name: Task, region and policy with its training, as a table and a legend call it.
        shares: Strict successes and rollouts, by the name of the variation.
        age: What stands behind its name where it is of an earlier version.
    """

    name: str
    shares: Mapping[str, tuple[int, int]]
    age: str = ""

    def percent(self, variation: str) -> str:
        """Return the rate [%] in worlds that vary so; "-" where nothing was measured."""
        successes, episodes = self.shares.get(variation, (0, 0))
        return f"{100 * successes / episodes:.0f}" if episodes else "-"

    def points(self, group: str) -> list[Point]:
        """Return a curve over the strength of a group, from the plain world on."""
        found = []
        for strength in (0.0, *STRENGTHS):
            successes, episodes = self.shares.get(graded(group if strength else None, strength), (0, 0))
            if episodes:
                found.append((strength, successes / episodes, *wilson(successes, episodes)))
        return found


def measured(lines: Path) -> list[Row]:
    """Return what the lines of ``demohlm benchmark robustness`` say, the last of each cell.

    Of several policies of one kind, task and region it is the one that was measured last.

    Raises:
        DatasetError: There is no such file, or it is damaged.
    """
    found: dict[str, dict[str, tuple[int, int]]] = {}
    hashes: dict[str, str] = {}
    for line in jsonl.read(lines):
        if "group" in line and SUCCESS in line:
            share = round(line[SUCCESS]["rate"] * line["episodes"]), line["episodes"]
            group = line["group"] if line["strength"] else None
            name = f"{line['task']} {line['region']}, {line['policy']}"
            if hashes.setdefault(name, line["policy_hash"]) != line["policy_hash"]:
                hashes[name], found[name] = line["policy_hash"], {}
            found.setdefault(name, {})[graded(group, line["strength"])] = share
    return [Row(name=name, shares=shares) for name, shares in found.items()]


def scored(results: Iterable[PolicyResult]) -> list[Row]:
    """Return what ``demohlm reproduce --table robustness`` has found, of policies that it measured under some group.

    Trainings of different numbers of steps are different policies.
    """
    found: dict[tuple[str, str], dict[str, tuple[int, int]]] = {}
    for line in latest(results, any_steps=True):
        if line.perception == "exact" and line.successes_strict is not None:
            data = f"{line.num_train_episodes} {line.variant}"
            trained = f"{method_title(line.policy, line.preset)} of {data}{steps_title(line)}"
            cells = found.setdefault((f"{line.task} {line.region}, {trained}", age(line)), {})
            before = cells.get(line.variation, (0, 0))  # of another seed of the training
            cells[line.variation] = before[0] + line.successes_strict, before[1] + line.episodes
    wanted = {graded(group, strength) for group in GROUPS for strength in STRENGTHS}
    return [
        Row(name=name, shares=shares, age=aged)
        for (name, aged), shares in sorted(found.items())
        if wanted & shares.keys()
    ]


def table(rows: Iterable[Row]) -> str:
    """Return a Markdown table of policies against groups: strict success [%] at each strength; none without a row."""
    strengths = " / ".join(f"{strength:g}" for strength in STRENGTHS)
    header = ["task, region, policy", "plain", *(f"{group}, x {strengths}" for group in GROUPS)]
    texts = []
    for row in rows:
        cells = [" / ".join(row.percent(graded(group, strength)) for strength in STRENGTHS) for group in GROUPS]
        texts.append([row.name + row.age, row.percent(graded(None, 0.0)), *cells])
    title = f"**Strict success [%] in worlds that vary by one group of `{GRADED}`**"
    return f"{title}\n\n{markdown(header, texts)}" if texts else ""


def draw(rows: Iterable[Row], figure: Path) -> None:
    """Draw strict success against strength, a picture a group, with 95 % intervals.

    Args:
        rows: A curve each.
        figure: Image file; its folder is made.
    """
    rows = list(rows)
    panels = [
        Panel(
            title=group, label=f"strength of {GRADED}", curves={row.name + row.age: row.points(group) for row in rows}
        )
        for group in GROUPS
    ]
    draw_panels(panels, "strict success", figure, panel_size=(2.6, 3.0))
