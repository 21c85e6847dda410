"""Tasks -> an episode of each as film strips and videos from two cameras, on one HTML page and one for a repository."""

import argparse
import importlib.resources
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import jinja2

from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.datasets.facts import require_new_root
from lerobot_demohlm.reports.films import CAMERAS, Take, generated_take, policy_take, write_take
from lerobot_demohlm.reproducibility import provenance


def render_page(takes: Sequence[Take], template: str, folder: str, videos: bool) -> str:
    """Return a page that shows takes.

    Args:
        takes: One a task.
        template: "gallery.html.j2" or "gallery.md.j2".
        folder: Where strips and videos lie, seen from the page.
        videos: Whether there are videos.
    """
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined,
        autoescape=template.endswith(".html.j2"),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    text = (importlib.resources.files("lerobot_demohlm.reports") / "templates" / template).read_text()
    shown = [{"take": take, "stem": provenance.file_name(take.task)} for take in takes]
    return environment.from_string(text).render(shown=shown, cameras=CAMERAS, folder=folder, videos=videos)


def write_markdown(takes: Sequence[Take], root: Path, page: Path) -> None:
    """Write a Markdown page, and beside it the strips in a folder of its name.

    Args:
        takes: Written to root before.
        root: Where their strips are.
        page: The file; written over where it exists, as are the strips.
    """
    folder = page.with_suffix("")
    folder.mkdir(parents=True, exist_ok=True)
    for take in takes:
        for camera in CAMERAS:
            name = f"{provenance.file_name(take.task)}_{camera}.png"
            shutil.copyfile(root / name, folder / name)
    page.write_text(render_page(takes, "gallery.md.j2", os.path.relpath(folder, page.parent), videos=False))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm gallery``."""
    parser.add_argument("--task", nargs="+", help="names of tasks, such as LiftBox (default: all)")
    parser.add_argument("--region", default=DEFAULT_REGION, help="initial region, R1 to R3 (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the initial states (default: %(default)s)")
    parser.add_argument("--index", type=int, default=0, help="which attempt of that seed (default: %(default)s)")
    parser.add_argument("--demonstration", type=Path, help="directory of the demonstration (default: the packaged one)")
    parser.add_argument("--policy", type=Path, help="pretrained_model to roll out from --seed instead; of one task")
    parser.add_argument("--root", type=Path, required=True, help="directory of pages and films; must not exist")
    parser.add_argument("--markdown", type=Path, help="write a Markdown page too, strips in a folder of its name")
    parser.add_argument("--no-videos", action="store_true", help="strips only, which is many times quicker")


def main(arguments: argparse.Namespace) -> None:
    """Write strips, videos and pages; a task that fails is shown as it failed."""
    require_new_root(arguments.root)
    tasks = [get_task(name) for name in arguments.task] if arguments.task else list(all_tasks().values())
    single = arguments.policy or arguments.demonstration
    if single and len(tasks) != 1:
        raise DatasetError(f"{len(tasks)} tasks for {single}", "one task", "name it with --task")
    if arguments.seed < 0 or arguments.index < 0:
        raise DatasetError(f"seed={arguments.seed}, index={arguments.index}", "0 or more", "change them")
    for task in tasks:
        task.region(arguments.region)
    takes = []
    for task in tasks:
        if arguments.policy:
            take = policy_take(task, arguments.region, arguments.seed, arguments.policy)
        else:
            take = generated_take(task, arguments.region, arguments.seed, arguments.index, arguments.demonstration)
        write_take(take, arguments.root, videos=not arguments.no_videos)
        print(f"{task.name}, {take.caption}", flush=True)
        takes.append(take)
        _write_pages(takes, arguments)  # after each task: a run that is stopped leaves what it has done


def _write_pages(takes: Sequence[Take], arguments: argparse.Namespace) -> None:
    page = arguments.root / "index.html"
    page.write_text(render_page(takes, "gallery.html.j2", ".", videos=not arguments.no_videos))
    if arguments.markdown is not None:
        write_markdown(takes, arguments.root, arguments.markdown)
