"""A name, a path or a hash -> the weights file of a controller; several controllers are installed side by side.

Each file is named by the first digits of its hash, so that what was recorded with a controller finds it again.
``default.txt`` beside them names the one that is used where none is asked for.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.control.settings import Settings
from gym_demohlm.control.whole_body import DEFAULT_NAME, WEIGHTS_FOLDER, Weights, read_arrays
from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.files import replace_text, replacing

DEFAULT = "default"
MEASURED = WEIGHTS_FOLDER / "measured.jsonl"
"""Lines of ``demohlm benchmark controller``, one for each controller in the package."""
HASH_DIGITS = 12
"""Of its hash, that a controller's file is named by."""


@dataclass(frozen=True, kw_only=True)
class Installed:
    """A controller in the package.

    Attributes:
        name: The first digits of its hash.
        hash: SHA-256 of its file.
        path: Of its file.
        is_default: Whether it is used where none is asked for.
    """

    name: str
    hash: str
    path: Path
    is_default: bool


def installed(folder: Path = WEIGHTS_FOLDER) -> list[Installed]:
    """Return the controllers in a folder, the default one first."""
    default = (folder / DEFAULT_NAME.name).read_text().strip()
    found = [
        Installed(
            name=path.stem,
            hash=hashlib.sha256(path.read_bytes()).hexdigest(),
            path=path,
            is_default=path.stem == default,
        )
        for path in sorted(folder.glob("*.npz"))
    ]
    return sorted(found, key=lambda controller: not controller.is_default)


def find(wanted: str, folder: Path = WEIGHTS_FOLDER) -> Path:
    """Return the weights file of a controller.

    Args:
        wanted: ``default``, the hash of an installed controller or at least its first eight digits, or a path.
        folder: Where controllers are installed.

    Raises:
        SceneError: A path where there is no file.
        UnknownNameError: No controller is installed that is called so.
    """
    if wanted.endswith(".npz"):
        path = Path(wanted)
        if not path.is_file():
            raise SceneError(f"no file {wanted}", "an .npz file exported by demohlm train-controller", "check the path")
        return path
    there = installed(folder)
    for controller in there:
        if (wanted == DEFAULT and controller.is_default) or _begins(controller.hash, wanted):
            return controller.path
    raise UnknownNameError("controller", wanted, [DEFAULT, *(controller.name for controller in there)])


def load(wanted: str = DEFAULT) -> Weights:
    """Read the weights of a controller; arguments and errors as ``find`` and ``Weights``."""
    return Weights(find(wanted))


def recorded(digest: str | None) -> str | None:
    """Return the name of the installed controller with a hash that was recorded; None where it is not installed."""
    return next((controller.name for controller in installed() if controller.hash == digest), None)


def install(path: Path, folder: Path = WEIGHTS_FOLDER) -> Path:
    """Copy a weights file into the package under its hash; returns where to.

    Raises:
        SceneError: As ``Weights``: a file that is damaged is not installed.
    """
    there = folder / f"{Weights(path).hash[:HASH_DIGITS]}.npz"
    with replacing(there) as beside:
        beside.write_bytes(path.read_bytes())
    return there


def make_default(name: str, folder: Path = WEIGHTS_FOLDER) -> None:
    """Use an installed controller where none is asked for, from the next process on.

    Raises:
        UnknownNameError: No controller is installed that is called so.
    """
    replace_text(folder / DEFAULT_NAME.name, find(name, folder).stem + "\n")


def rewrite(weights: Path, output: Path, **changed: Any) -> None:  # noqa: ANN401
    """Write a controller's file with other metadata; its network and tables stay bit for bit.

    Args:
        weights: The file.
        output: Of the file to write, replaced at once.
        **changed: Metadata, such as ``gait`` or ``velocity_map``, see ``Settings.metadata``.

    Raises:
        SceneError: The file is damaged, or a setting is not known or out of range.
    """
    _, metadata, _ = read_arrays(weights)
    metadata |= changed
    Settings.read(metadata)
    with np.load(weights, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    arrays["metadata"] = np.frombuffer(json.dumps(metadata).encode(), dtype=np.uint8)
    with replacing(output) as beside, beside.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def tune(weights: Path, output: Path, gait: Mapping[str, Any]) -> None:
    """Write a controller that walks with other settings, not trained again.

    Args:
        weights: The file of the controller.
        output: Of the file to write, replaced at once.
        gait: Name of a setting of ``Gait`` -> its value.

    Raises:
        UnknownNameError: There is no such setting.
        SceneError: As ``rewrite``.
    """
    now = Weights(weights).settings.gait
    for name in gait:
        if name not in vars(now):
            raise UnknownNameError("setting of the gait", name, vars(now))
    rewrite(weights, output, gait={**vars(now), **gait})


def _begins(digest: str, wanted: str) -> bool:
    return len(wanted) >= 8 and digest.startswith(wanted.lower())
