"""The features of a dataset -> ``meta/modality.json``, by which NVIDIA's GR00T reads parts of the vectors by name.

State and action are divided into limbs, so that GR00T normalises each by itself; an object's pose is a part of its own.
Depth is left out: GR00T decodes colour pictures only.
"""

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gym_demohlm.errors import DatasetError
from gym_demohlm.robot import g1
from gym_demohlm.robot.neck import NECK_JOINTS
from lerobot_demohlm.datasets.pictures import is_depth, is_video

FILE = Path("meta", "modality.json")
SENTENCE = "human.task_description"
"""Key of the task's sentence, which GR00T is asked for as ``annotation.human.task_description``."""
_LIMBS: dict[str, tuple[str, ...]] = {
    "base": ("base_x", "base_y", "base_yaw"),
    "torso": ("torso_height", "torso_roll", "torso_pitch", "torso_yaw"),
    "waist": g1.WAIST_JOINTS,
    "neck": NECK_JOINTS,
    **{
        f"{side}_{limb}": tuple(joint for joint in joints if joint.startswith(side))
        for limb, joints in (
            ("leg", g1.LEG_JOINTS),
            ("arm", g1.ARM_JOINTS),
            ("gripper", tuple(f"{side}_gripper{end}" for side in g1.SIDES for end in ("", "_jaw"))),
        )
        for side in g1.SIDES
    },
}
_LIMB_OF = {joint: limb for limb, joints in _LIMBS.items() for joint in joints}


def write_modality(root: Path, features: Mapping[str, Mapping[str, Any]]) -> None:
    """Write the file.

    Args:
        root: Of the dataset.
        features: Its table of features.
    """
    (root / FILE).write_text(json.dumps(modality(features), indent=2) + "\n")


def modality(features: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the content of the file.

    Args:
        features: The dataset's table of features.

    Raises:
        DatasetError: A number of state or action is of no known limb.
    """
    state, objects, action = ("observation.state", "observation.environment_state", "action")
    commands = _parts(features[action]["names"], _limb, action)
    commands["base_velocity"]["absolute"] = False  # after an episode's end the robot stands: GR00T pads with zeros
    return {
        "state": _parts(features[state]["names"], _limb, state) | _parts(features[objects]["names"], _object, objects),
        "action": commands,
        "video": {
            key.removeprefix("observation.images."): {"original_key": key}
            for key, feature in features.items()
            if is_video(feature) and not is_depth(feature)
        },
        "annotation": {SENTENCE: {"original_key": "task_index"}},
    }


def _parts(names: Sequence[str], part_of: Callable[[str], str], key: str) -> dict[str, dict[str, Any]]:
    """Return the slice ``[start, end)`` of each run of numbers of one part."""
    found: dict[str, dict[str, Any]] = {}
    for part, run in itertools.groupby(range(len(names)), lambda index: part_of(names[index])):
        indices = list(run)
        found[part] = {"start": indices[0], "end": indices[-1] + 1, "original_key": key}
    return found


def _limb(name: str) -> str:
    """Return the part that ``left_elbow.pos`` or ``left_elbow.vel`` belongs to."""
    joint, _, kind = name.rpartition(".")
    if joint not in _LIMB_OF:
        raise DatasetError(f"a number {name!r} of state or action", f"one of {', '.join(_LIMB_OF)}", "add it to a limb")
    return _LIMB_OF[joint] + ("_velocity" if kind == "vel" else "")


def _object(name: str) -> str:
    """Return the object that ``cube_x.pos`` belongs to."""
    return name.rpartition("_")[0]
