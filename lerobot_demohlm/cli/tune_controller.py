"""``demohlm tune-controller``."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from gym_demohlm.errors import SceneError


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm tune-controller``.

    Attributes:
        controller: Name of a controller, path of its weights, or the first eight or more digits of their hash.
        output: File to write.
        gait: Settings of the gait, as NAME=VALUE; a value is a number or a list such as [0.1,0.08,0.13].
    """

    controller: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CONTROLLER")] = "default"
    output: Path
    gait: tuple[str, ...]


def run(options: Options) -> None:
    """Write the controller; the last line on stdout is a JSON object with its path and hash."""
    from gym_demohlm.control import controllers
    from gym_demohlm.control.whole_body import Weights

    gait = dict(map(_parse, options.gait))
    weights = controllers.find(options.controller)
    Weights(weights)  # a damaged file is not the fault of --gait
    options.output.parent.mkdir(parents=True, exist_ok=True)
    try:
        controllers.tune(weights, options.output, gait)
    except SceneError as error:
        raise SceneError(error.got, error.expected, "correct --gait") from error
    print(json.dumps({"weights": str(options.output), "hash": Weights(options.output).hash}))


def _parse(text: str) -> tuple[str, Any]:
    """Return name and value of ``NAME=VALUE``."""
    name, _, value = text.partition("=")
    try:
        return name, json.loads(value)
    except ValueError:
        raise SceneError(f"the setting {text!r}", "NAME=VALUE", "for example recovery_s=4") from None
