"""A name, a path or a hash -> the weights file of a controller; several controllers are installed side by side.

The default one is ``weights/g1_whole_body.npz``; the others are named by the first digits of their hash, so that what
was recorded with a controller finds it again.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from gym_demohlm.control.whole_body import DEFAULT_WEIGHTS, Weights
from gym_demohlm.errors import SceneError, UnknownNameError

DEFAULT = "default"
HASH_DIGITS = 12
"""Of its hash, that a controller's file is named by."""


@dataclass(frozen=True, kw_only=True)
class Installed:
    """A controller in the package.

    Attributes:
        name: ``default``, or the first digits of its hash.
        hash: SHA-256 of its file.
        path: Of its file.
    """

    name: str
    hash: str
    path: Path


def installed(folder: Path = DEFAULT_WEIGHTS.parent) -> list[Installed]:
    """Return the controllers in a folder, the default one first."""
    found = []
    for path in sorted(folder.glob("*.npz"), key=lambda path: (path.name != DEFAULT_WEIGHTS.name, path.name)):
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        name = DEFAULT if path.name == DEFAULT_WEIGHTS.name else path.stem
        found.append(Installed(name=name, hash=digest, path=path))
    return found


def find(wanted: str, folder: Path = DEFAULT_WEIGHTS.parent) -> Path:
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
        if wanted == controller.name or (len(wanted) >= 8 and controller.hash.startswith(wanted.lower())):
            return controller.path
    raise UnknownNameError("controller", wanted, [controller.name for controller in there])


def install(path: Path, folder: Path = DEFAULT_WEIGHTS.parent) -> Path:
    """Copy a weights file into the package under its hash; returns where to.

    Raises:
        SceneError: As ``Weights``: a file that is damaged is not installed.
    """
    name = Weights(path).hash[:HASH_DIGITS]
    there = folder / f"{name}.npz"
    there.write_bytes(path.read_bytes())
    return there
