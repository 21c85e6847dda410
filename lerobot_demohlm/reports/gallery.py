"""Tasks -> an episode of each as film strips and videos from two cameras, on one HTML page and one for a repository."""

import importlib.resources
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import jinja2

from lerobot_demohlm.reports.films import CAMERAS, Take


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
    shown = [{"take": take, "stem": take.task.slug} for take in takes]
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
    if not folder.samefile(root):  # else the strips are there
        for take in takes:
            for camera in CAMERAS:
                name = f"{take.task.slug}_{camera}.png"
                shutil.copyfile(root / name, folder / name)
    page.write_text(render_page(takes, "gallery.md.j2", os.path.relpath(folder, page.parent), videos=False))


def write_pages(takes: Sequence[Take], root: Path, markdown: Path | None = None, videos: bool = True) -> None:
    """Write the HTML page of takes whose films are in a folder, and a Markdown page where one is wanted.

    Args:
        takes: In the order of the page.
        root: Folder of the films; the page is its index.html.
        markdown: File of the Markdown page; its strips go into a folder of its name.
        videos: Whether there are videos beside the strips.
    """
    (root / "index.html").write_text(render_page(takes, "gallery.html.j2", ".", videos=videos))
    if markdown is not None:
        write_markdown(takes, root, markdown)
