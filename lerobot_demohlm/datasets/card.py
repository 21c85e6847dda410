"""Turns a dataset's facts into its card, the ``README.md`` that the hub shows.

A ready card in ``dataset_cards/`` is a card as it would be pushed; beside it lie the facts that it is rendered from.
"""

import importlib.resources
import json
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import OBS_ENV_STATE

from gym_demohlm.errors import DatasetError
from gym_demohlm.files import replace_text
from gym_demohlm.registry import get_task
from gym_demohlm.variation import get_variation
from lerobot_demohlm.datasets.cameras import PictureFacts, is_video
from lerobot_demohlm.datasets.facts import read_facts, read_info

TEMPLATE = "card.md.j2"
FACTS_FOLDER = "facts"
"""Folder inside of ``dataset_cards/`` with what each card is rendered from."""
_POSE_NUMBERS = 9  # of an object in the environment's state: position, and two columns of the rotation
_HANDS = {"rubber": "rubber hands", "gripper": "parallel grippers"}


def card_values(meta: LeRobotDatasetMetadata, repo_id: str, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a card is rendered from, as JSON can hold it.

    Args:
        meta: Metadata of the dataset.
        repo_id: Its name on the hub.
        facts: Content of ``meta/demohlm.json``.
    """
    assert meta.episodes is not None  # a dataset has episodes
    labels = [meta.episodes[name] for name in ("outcome", "stage") if name in meta.episodes.column_names]
    ends = Counter(zip(*labels, strict=True))  # empty where an earlier version wrote the dataset
    info = meta.info
    totals = {"total_episodes": info.total_episodes, "total_frames": info.total_frames, "fps": info.fps}
    features = {
        key: {"dtype": feature["dtype"], "shape": list(feature["shape"]), "names": feature["names"]}
        for key, feature in meta.features.items()
    }
    return {
        "repo_id": repo_id,
        "facts": dict(facts),
        "info": totals,
        "features": features,
        "ends": [[*end, count] for end, count in sorted(ends.items())],
    }


def render_values(values: Mapping[str, Any]) -> str:
    """Return the card in Markdown.

    Args:
        values: What ``card_values`` returned.
    """
    template = (importlib.resources.files("lerobot_demohlm.datasets") / TEMPLATE).read_text()
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=False, keep_trailing_newline=True)
    ends = [((outcome, stage), count) for outcome, stage, count in values["ends"]]
    facts, features = values["facts"], values["features"]
    pictures = PictureFacts.read(facts if any(map(is_video, features.values())) else {})  # failed attempts have none
    poses = values["features"][OBS_ENV_STATE]["shape"][0] // _POSE_NUMBERS
    return (
        environment.from_string(template)
        .render(
            repo_id=values["repo_id"],
            facts=facts,
            info=values["info"],
            features=features,
            ends=ends,
            failed=bool(ends) and all(outcome != "success" for (outcome, _), _ in ends),
            num_objects=poses,
            hands=_HANDS[get_task(facts["task"]).hands],
            varied=get_variation(facts.get("variation", "none")).groups,
            perception=facts.get("perception", "exact"),
            cameras=[str(camera) for camera in pictures.cameras],
            lit=pictures.light > 0.0,
        )
        .lstrip()
    )


def render_card(meta: LeRobotDatasetMetadata, repo_id: str, facts: Mapping[str, Any]) -> str:
    """Return the card of a dataset in Markdown.

    Args:
        meta: Metadata of the dataset.
        repo_id: Its name on the hub.
        facts: Content of ``meta/demohlm.json``.
    """
    return render_values(card_values(meta, repo_id, facts))


def is_by_hand(path: Path, meta: LeRobotDatasetMetadata, facts: Mapping[str, Any]) -> bool:
    """Tell whether a dataset's card is not as it was rendered, so that somebody may have edited it.

    Args:
        path: Of the card, which may be missing.
        meta: Metadata of the dataset.
        facts: Content of ``meta/demohlm.json``.
    """
    if not path.exists():
        return False
    text = path.read_text(errors="replace")
    named = re.search(r'LeRobotDataset\("([^"]*)"', text)
    return named is None or text != render_card(meta, named[1], facts)


def write_card(root: Path, repo_id: str, facts: Mapping[str, Any]) -> None:
    """Write the card of the dataset at ``root``."""
    meta = LeRobotDatasetMetadata(repo_id, root=root)
    replace_text(root / "README.md", render_card(meta, repo_id, facts))


def write_ready_card(root: Path, repo_id: str, folder: Path) -> Path:
    """Write a dataset's card into a folder of ready cards, ``TASK.md``, and its facts beside it, ``facts/TASK.json``.

    Args:
        root: Root of the dataset.
        repo_id: Its name on the hub, ``user/name``.
        folder: Such as ``dataset_cards``.

    Returns:
        The card's path.

    Raises:
        DatasetError: There is no such dataset, it is damaged, or another version wrote it.
    """
    facts = read_facts(root)
    read_info(root)  # LeRobot does not say what is damaged
    values = card_values(LeRobotDatasetMetadata(repo_id, root=root), repo_id, facts)
    name = get_task(facts["task"]).slug
    kept, card = folder / FACTS_FOLDER / f"{name}.json", folder / f"{name}.md"
    kept.parent.mkdir(parents=True, exist_ok=True)
    replace_text(kept, json.dumps(values, indent=1) + "\n")
    replace_text(card, render_values(values))
    return card


def render_ready_cards(folder: Path) -> list[Path]:
    """Render all cards of a folder again from the facts that lie beside them, and return their paths.

    Args:
        folder: Such as ``dataset_cards``.

    Raises:
        DatasetError: The folder holds no facts, or damaged ones.
    """
    kept = sorted((folder / FACTS_FOLDER).glob("*.json"))
    if not kept:
        raise DatasetError(f"{folder} without {FACTS_FOLDER}/*.json", "a folder of ready cards", "check --folder")
    cards = []
    for path in kept:
        cards.append(folder / f"{path.stem}.md")
        try:
            text = render_values(json.loads(path.read_text()))
        except (ValueError, TypeError, KeyError, AttributeError, jinja2.UndefinedError) as error:
            raise DatasetError(f"{path}, damaged ({error})", "the facts of a card", "write the card again") from error
        replace_text(cards[-1], text)
    return cards
