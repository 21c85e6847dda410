"""``demohlm doctor``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from lerobot_demohlm.cli.parsing import default, only


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm doctor``.

    Attributes:
        tasks: Compare the behaviour of all ten tasks as well, which takes about a minute.
        write: Write this machine's digests to this file, in the format of digests.json.
        append: Append a line about this processor to this file of results.
    """

    tasks: bool = False
    write: Annotated[Path | None, default("none")] = None
    append: Annotated[Path | None, default("none")] = None


def run(options: Options) -> int:
    """Print what was found; exit code 1 where something has to be mended."""
    from lerobot_demohlm.checks import doctor

    return doctor.run(only(doctor.DoctorOptions, options))
