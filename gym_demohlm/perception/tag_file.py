"""A file that says which printed AprilTag is where on which object -> tags that ``object_pose`` can use.

``{"box": [{"id": 3, "size_m": 0.05, "pose": [x, y, z, qw, qx, qy, qz]}]}``: the length of the black square's side, and
the tag's pose in its object's frame, x to the right of the printed tag, y up, z out of it.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm import poses
from gym_demohlm.errors import SceneError
from gym_demohlm.perception.tag_layout import Tag


def read_tags(path: Path, names: Sequence[str]) -> tuple[tuple[Tag, ...], ...]:
    """Return the tags of each object.

    Args:
        path: The file.
        names: The objects; others in the file are left out.

    Raises:
        SceneError: The file cannot be read, an object has no tag, or two tags have one id.
    """
    try:
        content = json.loads(path.read_text())
        found = {name: tuple(_tag(entry) for entry in entries) for name, entries in content.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise SceneError(
            f"tags that cannot be read ({error})", '{"box": [{"id": 3, "size_m": 0.05, "pose": [7 numbers]}]}',
            "see docs/deployment.md",
        ) from error  # fmt: skip
    missing = [name for name in names if not found.get(name)]
    if missing:
        raise SceneError(f"no tag on {', '.join(missing)}", "one on each object of the task", f"add it to {path.name}")
    ids = [tag.id for tags in found.values() for tag in tags]
    if len(set(ids)) < len(ids):
        raise SceneError(f"tags {sorted(ids)}", "each id once", f"correct {path.name}")
    return tuple(found[name] for name in names)


def _tag(entry: Mapping[str, Any]) -> Tag:
    numbers, edge = np.array(entry["pose"], dtype=float), float(entry["size_m"])
    if numbers.shape != (7,) or not np.isfinite(numbers).all() or not numbers[3:].any() or not 0.0 < edge < 10.0:
        raise ValueError(f"tag {entry.get('id')} without seven numbers and a size")
    quat = numbers[3:] / np.linalg.norm(numbers[3:])
    return Tag(id=int(entry["id"]), T_object_tag=poses.pose(numbers[:3], quat), edge=edge)
