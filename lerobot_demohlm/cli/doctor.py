"""``demohlm doctor``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from lerobot_demohlm.checks.doctor import DoctorOptions
from lerobot_demohlm.checks.doctor import run as examine
from lerobot_demohlm.cli.parsing import default, only


@dataclass(frozen=True, kw_only=True)
class Options(DoctorOptions):
    """Options of ``demohlm doctor``.

    Attributes:
        tasks: Compare the behaviour of all packaged tasks, too, which takes about a minute.
        write: Write this machine's digests to this file, in the format of digests.json.
        append: Append a line about this processor to this file of results.
    """

    write: Annotated[Path | None, default("none")] = None
    append: Annotated[Path | None, default("none")] = None


def run(options: Options) -> int:
    """Examine this machine; exit code 1 where something is wrong."""
    return examine(only(DoctorOptions, options))
