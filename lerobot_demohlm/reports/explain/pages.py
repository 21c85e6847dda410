"""Templates of this package -> HTML pages with everything inside."""

import importlib.resources
from pathlib import Path
from typing import Any

import jinja2

from gym_demohlm.errors import DatasetError
from lerobot_demohlm.datasets.facts import installed_versions


def render(template: str, **values: Any) -> str:  # noqa: ANN401
    """Fill a template in; it must use nothing that it is not given."""
    folder = importlib.resources.files("lerobot_demohlm.reports") / "templates"
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda name: (folder / name).read_text()),
        undefined=jinja2.StrictUndefined,
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(versions=installed_versions(), **values)


def require_new(path: Path) -> None:
    """Raise ``DatasetError`` where a file exists: a page is never written over another one."""
    if path.exists():
        raise DatasetError(f"the file {path}, which exists", "a new file", "choose another --output")


def write(path: Path, page: str) -> None:
    """Write a page to a new file, whose directory is made where it is missing."""
    require_new(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page)
