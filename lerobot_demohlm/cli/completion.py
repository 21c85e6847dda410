"""All verbs -> a script that completes verbs, options and their choices in a shell."""

import contextlib
import dataclasses
import importlib
import io
from typing import Annotated, Any, Union

import tyro

from lerobot_demohlm.cli.parsing import MARKERS
from lerobot_demohlm.cli.verbs import VERBS, Verb


def script(shell: str) -> str:
    """Return the script.

    Args:
        shell: "bash" or "zsh".
    """
    said = io.StringIO()
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(said):
        tyro.cli(
            _choice([verb for verb in VERBS if len(verb.words) == 1]),
            prog="demohlm",
            args=["--tyro-write-completion", shell, "-"],
            config=(*MARKERS, tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes),
        )
    return said.getvalue().rstrip()


def _choice(verbs: list[Verb]) -> Any:  # noqa: ANN401
    """Return a type of which tyro makes one subcommand a verb."""
    kinds = tuple(
        Annotated[_options(verb), tyro.conf.subcommand(verb.words[-1], description=verb.sentence)] for verb in verbs
    )
    return Union[kinds]  # noqa: UP007  # made of a list


def _options(verb: Verb) -> type:
    """Return the options of a verb, with its parts as subcommands where it has some."""
    options = importlib.import_module(verb.module).Options
    parts = [other for other in VERBS if other.words[:-1] == verb.words]
    if not parts:
        return options
    part = ("part", _choice(parts) | Annotated[None, tyro.conf.subcommand("-")], dataclasses.field(default=None))
    return dataclasses.make_dataclass(options.__name__, [part], bases=(options,), frozen=True, kw_only=True)
