"""``demohlm segment``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.errors import DemonstrationError
from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm segment``.

    Attributes:
        task: Name of the task, such as LiftBox.
        root: Directory of the demonstration.
        figure: Draw the timeline into this PNG or SVG file.
        write_corrections: Write the segments to meta/segments.json of --root, to be corrected there by hand.
    """

    task: str
    root: Annotated[Path | None, default("the packaged one")] = None
    figure: Annotated[Path | None, default("no figure")] = None
    write_corrections: bool = False


def run(options: Options) -> None:
    """Print the events, segments and pauses of a demonstration, draw it, write segments down for corrections.

    Raises:
        DemonstrationError: It cannot be read, or what is to be written is the package's own or no picture.
    """
    from gym_demohlm.registry import get_task
    from gym_demohlm.timing import STEP_DT
    from lerobot_demohlm.demonstrations.demonstration import load
    from lerobot_demohlm.demonstrations.pauses import pauses
    from lerobot_demohlm.demonstrations.segmentation import events, segment, write_corrections

    if options.write_corrections and options.root is None:
        raise DemonstrationError(
            "--write-corrections of a packaged demonstration", "one of your own", "copy it, and give --root"
        )
    if options.figure is not None and options.figure.suffix not in (".png", ".svg"):
        raise DemonstrationError(f"the figure {options.figure}", "a name that ends in .png or .svg", "correct --figure")
    task = get_task(options.task)
    demonstration = load(options.root, task)
    print("   tick  hand   event")
    for event in events(demonstration, task):
        print(f"{event.tick:>7}  {event.hand:<5}  {event.kind} {event.object or 'gripper'}")
    print("\n  ticks    hand   follows")
    for entry in segment(demonstration, task):
        what = entry.object if entry.kind == "object" else f"its own motion ({entry.anchor})"
        print(f"{entry.start:>4}-{entry.stop:<4}  {entry.hand:<5}  {what}")
    rests = pauses(demonstration)
    print("\n  ticks    pause" if rests else "\nno pause of a second")
    for start, stop in rests:
        print(f"{start:>4}-{stop:<4}  {(stop - start) * STEP_DT:.1f} s")
    if options.figure is not None:
        from lerobot_demohlm.demonstrations.timeline import write_timeline

        write_timeline(demonstration, options.figure)
        print(f"\n{options.figure}")
    if options.write_corrections and options.root is not None:
        path = write_corrections(demonstration, task, options.root)
        print(f"\n{path}: correct it by hand; remove it to have the segments found again")
