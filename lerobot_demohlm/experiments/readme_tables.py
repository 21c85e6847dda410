"""Measured results, one JSON line each in ``results/``, -> ``docs/results.md`` and the tables of other pages.

A line says what was measured, by which command, at which commit. Tables are made from lines alone; nothing is typed in.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path

from gym_demohlm.errors import DatasetError
from gym_demohlm.files import replace_text
from lerobot_demohlm.datasets.variation import DataVariation
from lerobot_demohlm.experiments import paper, robustness, varied_tables
from lerobot_demohlm.experiments.lines import (
    GenerationResult,
    Result,
    newest,
    read_generation,
    read_measurements,
    read_policies,
)
from lerobot_demohlm.experiments.measured_tables import MEASURED
from lerobot_demohlm.experiments.rates import EARLIER, age, generated, markdown
from lerobot_demohlm.experiments.tables import experiments_tables, perception_counts, regions_table

CAVEATS = """\
These numbers come from a simulation that is kinder than a laboratory. Read them with this in mind. Tables of worlds
that vary and of eyes that err say so; what follows is of the plain world, which all others are of.

- **Less turning than the regions suggest.** R3 turns objects by up to 180 degrees. But the objects of eight tasks look
  the same after a quarter turn, three tasks limit the turn to 45 degrees because a door, a cart and a board have a
  front, and the vessels of PourWater are round. So no task asks for more than 45 degrees, and R2 and R3 add no
  turning to R1. R4 does ([docs/benchmark.md](benchmark.md)).
- **Exact poses.** Policies and the generator read the pose of every object without error, without delay, and also
  where the head camera could not see the object.
- **No noise and no variation in the world.** Mass, size, friction, motors and the robot's posture at the start are the
  same in every episode, and sensors have no noise. Only the commands in training data carry noise.
- **Two successes.** A success was held for a second. Where "strict" stands beside it, this is the share of attempts or
  rollouts that also dropped and hit nothing at any time, and whose robot stood for two more seconds
  ([docs/benchmark.md](benchmark.md)). Lines without it are from before that was judged.
- **Earlier judges.** A strict rate is by the judge of its commit. Two mends concern the two seconds in which a strict
  success must stand. Until commit 376a9d4 a neck whose eyes err, as those of `real` worlds do, could turn by up to
  1.5 rad. What that changes has not been measured. Until commit deca88b a thing could fall back to where it stood: in
  LiftBox an MLP of plain data under `real` has 113 strict successes of 250 instead of 125. In generation nothing
  fell after 159 successes in seven tasks (tuning starts under `real` in R3).
- **Statistics of before.** Policies trained before 5b318fa had deviations that were off by up to a tenth, in CarryBox
  by more, and Diffusion the state of an idle gripper far out of scale ([docs/policies.md](policies.md)).
- **Shared starts.** In rows of policies that have no strict number, all tasks are sampled from the same starts.
  Since then `demohlm reproduce` scores each task and region from starts of its own, which nothing else uses.
- **Scripted demonstrations.** The one demonstration of each task was recorded by a script, not by a person.
- **Friendly scenes.** Nothing lies around the objects, and the feet of pedestals do not collide.
- **A generator that reacts.** It steers the hands, checks grips and may walk to the object up to four times; the
  paper's generator replays without looking. In worlds that vary it also tries again, up to twice, what it missed.
- **Not the paper's conditions.** The paper's numbers stand beside ours for orientation. Its simulator, robot model,
  controller and demonstrations are others.

Small probes show the edge. With poses that are wrong by 2 cm the generator succeeds in 11 of 16 attempts at
GraspCube. A LiftBox policy with poses that are wrong by 1 cm and 3 degrees and 0.2 s late succeeds in 11 of 16
rollouts in R1. The robot lifts a box of 2 kg in 8 of 8 attempts and a box of 3 kg in none of 16. These probes were
made once, at commit 7873156, by a script that is not part of this repository.
"""


def _generation(lines: Sequence[GenerationResult]) -> str:
    rows = []
    for line in newest(lines, "task", "region", *(knob.name for knob in fields(DataVariation))):
        failed = ", ".join(f"{name} {count}" for name, count in line.outcomes.items() if name != "success" and count)
        theirs = paper.GENERATION.get((line.task, line.region))
        text = generated(line)
        if line.retries:
            text += f", with up to {line.retries} retries"
        if line.command_noise:
            text += f", with command noise {line.command_noise:g}"
        if line.start_spread != 1.0:
            text += f", starts {line.start_spread:g} times as wide"
        if line.stance_spread:
            text += f", stances spread by {line.stance_spread:g}"
        if line.variation != "none":
            text += f", in worlds that vary by {line.variation}"
        if line.perception != "exact":
            text += f", seen by {line.perception}"
        rows.append(
            [
                line.task,
                line.region,
                str(line.attempts),
                text,
                f"{theirs}" if theirs else "-",
                failed or "none",
                f"{line.episode_s:.1f}" if line.episode_s else "-",
                line.commit + age(line),
            ]
        )
    header = ["task", "region", "attempts", "success % (95 % interval)", "paper %"]
    header += ["failures", "s an episode", "commit"]
    return "**Generation**, every attempt counted\n\n" + markdown(header, rows)


def tables(results: Path) -> str:
    """Return the Markdown of all results, each with its age and the commands that made it.

    Args:
        results: Folder of JSON lines.

    Raises:
        DatasetError: A line is not what its file holds.
    """
    generation = read_generation(results / "generation.jsonl")
    policies = read_policies(results / "experiments.jsonl")
    parts = []
    if generation:
        text = "\n\n".join(part for part in (regions_table(generation), _generation(generation)) if part)
        parts.append(_section("Generation", text, generation))
    if policies:
        text = "\n\n".join(
            part for part in (experiments_tables(policies), robustness.table(robustness.scored(policies))) if part
        )
        parts.append(_section("Policies", text, policies))
    for name, heading, render in MEASURED:
        lines = read_measurements(results / name)
        if lines:
            parts.append(_section(heading, render(lines), lines))
    return "\n\n".join(parts) or "No results yet."


def _section(heading: str, text: str, lines: Sequence[Result]) -> str:
    """Return a heading, tables, how old they are, and the commands that made them."""
    commits = list(dict.fromkeys(line.commit for line in lines))
    if len(commits) > 3:
        made_at = f"{len(commits)} commits, {commits[0]} to {commits[-1]}"
    else:
        made_at = f"commit{'s' if len(commits) > 1 else ''} {', '.join(commits)}"
    aged = f"*Measured at {made_at}.*"
    if EARLIER in text:
        aged += (
            '\n\n*Rows marked "an earlier version" were measured before the task\'s demonstration, or the code that '
            "generates from it, became what it is now. The code of the eyes (`rgbd`, `apriltag`) is not looked at.*"
        )
    commands = "\n".join(dict.fromkeys(line.command for line in lines))
    folded = f"<details><summary>Commands</summary>\n\n```\n{commands}\n```\n\n</details>"
    return f"## {heading}\n\n{text}\n\n{aged}\n\n{folded}"


def results_page(results: Path) -> str:
    """Return ``docs/results.md``: what the numbers do not say, then all tables.

    Args:
        results: Folder of JSON lines.
    """
    intro = (
        "# Results\n\nEvery table on this page is made from the JSON lines in `results/` by\n"
        "`demohlm results --output docs/results.md`. A line keeps its command and its commit; `+` marks a working\n"
        "tree that differed from the commit, in older lines perhaps in `results/` alone."
    )
    return f"{intro}\n\n## What these numbers do not say\n\n{CAVEATS}\n{tables(results)}\n"


def write_results(output: Path, results: Path) -> bool:
    """Write ``docs/results.md`` and return whether it changed.

    Args:
        output: The file; made where it does not exist.
        results: Folder of JSON lines.
    """
    page = results_page(results)
    changed = not output.exists() or output.read_text() != page
    output.parent.mkdir(parents=True, exist_ok=True)
    replace_text(output, page)
    return changed


MARKED: Mapping[str, Callable[[Path], str]] = {
    "results": varied_tables.readme_table,
    "perception": lambda results: perception_counts(read_policies(results / "experiments.jsonl")),
    "generation": varied_tables.generation_table,
    "widest": varied_tables.widest_table,
    "sizes": varied_tables.sizes_table,
    "steps": varied_tables.steps_table,
    "seeds": varied_tables.seeds_table,
    "plain data": varied_tables.plain_data_table,
}
"""The tables that stand between markers ``<!-- NAME -->`` and ``<!-- /NAME -->`` of other pages."""


def update_page(page: Path, results: Path) -> bool:
    """Put tables between the markers of a page and return whether the file changed.

    Args:
        page: The file.
        results: Folder of JSON lines.

    Raises:
        DatasetError: There is no such file, or it has no markers, or one without the other.
    """
    if not page.is_file():
        raise DatasetError(f"no file {page}", "a page with markers of tables", "check --readme and --pages")
    before = text = page.read_text()
    for name, table in MARKED.items():
        begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
        if begin not in text and end not in text:
            continue
        head, _, rest = text.partition(begin)
        _, found, tail = rest.partition(end)
        if not found:
            raise DatasetError(f"{page.name} with one of {begin} and {end}", "both", "put them where the table belongs")
        text = f"{head}{begin}\n{table(results)}\n{end}{tail}"
    if not any(f"<!-- {name} -->" in text for name in MARKED):
        known = " or ".join(f"<!-- {name} --> and <!-- /{name} -->" for name in MARKED)
        raise DatasetError(f"{page.name} without markers", known, "put them where the table belongs")
    replace_text(page, text)
    return text != before
