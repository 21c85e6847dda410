"""Turns a dataset's facts into its card, the ``README.md`` that the hub shows."""

import importlib.resources
from collections import Counter
from pathlib import Path
from typing import Any

import jinja2
from lerobot.datasets import LeRobotDatasetMetadata

TEMPLATE = "generated.md.j2"


def render_card(meta: LeRobotDatasetMetadata, repo_id: str, facts: dict[str, Any]) -> str:
    """Return the card in Markdown.

    Args:
        meta: Metadata of the dataset.
        repo_id: Its name on the hub.
        facts: Content of ``meta/demohlm.json``.
    """
    template = (importlib.resources.files("lerobot_demohlm.datasets") / TEMPLATE).read_text()
    assert meta.episodes is not None  # a dataset has episodes
    labels = [meta.episodes[name] for name in ("outcome", "stage") if name in meta.episodes.column_names]
    ends = Counter(zip(*labels, strict=True))  # empty where an earlier version wrote the dataset
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=False, keep_trailing_newline=True)
    return (
        environment.from_string(template)
        .render(
            repo_id=repo_id,
            facts=facts,
            info=meta.info,
            features=meta.features,
            ends=sorted(ends.items()),
            failed=bool(ends) and all(outcome != "success" for outcome, _ in ends),
        )
        .lstrip()
    )


def write_card(root: Path, repo_id: str, facts: dict[str, Any]) -> None:
    """Write the card of the dataset at ``root``."""
    meta = LeRobotDatasetMetadata(repo_id, root=root)
    (root / "README.md").write_text(render_card(meta, repo_id, facts))
