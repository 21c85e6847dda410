"""``demohlm VERB ...`` -> the file that owns the verb, called with its options.

A verb's file has ``run(options)`` and ``Options``, a frozen dataclass whose fields and attribute docs are the verb's
flags and their help. The file is imported when its verb is asked for and not before, so that ``demohlm --help`` answers
at once; what takes long to import is imported by ``run``. A user's mistake is one line on stderr and exit code 2.
"""

import errno
import importlib
import sys
from collections.abc import Sequence

from gym_demohlm.errors import DemoHLMError, UnknownNameError
from lerobot_demohlm.cli.verbs import VERBS, Verb, overview
from lerobot_demohlm.reproducibility.processes import hush_torchcodec

INTERRUPTED = 130  # exit code of a process that was stopped from the keyboard
SHELLS = ("bash", "zsh")
EXTRAS = {
    **dict.fromkeys(("rsl_rl", "tensordict", "warp", "mujoco_warp"), "wbc"),
    **dict.fromkeys(("cyclonedds", "dynamixel_sdk", "serial"), "g1"),
    "ray": "ray",
}
"""Modules that come with an extra of the distribution."""
_FULL = (errno.ENOSPC, errno.EDQUOT)
_BAD_PATH = (errno.ENOENT, errno.EISDIR, errno.ENOTDIR, errno.EEXIST, errno.EACCES, errno.EPERM, errno.EROFS)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        argv: Arguments without the program's name; those of the process by default.
    """
    hush_torchcodec()
    try:
        return _run(list(sys.argv[1:] if argv is None else argv))
    except DemoHLMError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except OSError as error:
        if error.errno in _FULL:
            print(f"error: got {error.filename or 'a file'} ({error.strerror}); free some space", file=sys.stderr)
            return 2
        if error.filename is None or error.errno not in _BAD_PATH:
            raise
        print(f"error: got {error.filename} ({error.strerror}); check the paths of the command", file=sys.stderr)
        return 2
    except KeyboardInterrupt as stop:
        print(f"interrupted{f': {stop}' if str(stop) else ''}", file=sys.stderr)
        return INTERRUPTED


def _run(arguments: list[str]) -> int:
    if arguments and arguments[0] in ("-h", "--help"):
        print(overview())
        return 0
    if arguments and arguments[0].partition("=")[0] == "--print-completion":
        return _print_completion(" ".join(arguments).replace("=", " ").split()[1:])
    verb = _verb(arguments)
    return _carry_out(verb, arguments[len(verb.words) :])


def _verb(arguments: list[str]) -> Verb:
    """Return the verb with the most words that the arguments begin with."""
    fitting = [verb for verb in VERBS if tuple(arguments[: len(verb.words)]) == verb.words]
    if not fitting:
        names = sorted({verb.words[0] for verb in VERBS})
        if not arguments:
            raise DemoHLMError("no verb", f"one of {', '.join(names)}", "`demohlm --help` says what each does")
        raise UnknownNameError("verb", arguments[0], names)
    verb = max(fitting, key=lambda verb: len(verb.words))
    parts = [other.words[len(verb.words)] for other in VERBS if other.words[:-1] == verb.words]
    following = arguments[len(verb.words) : len(verb.words) + 1]
    if parts and following and not following[0].startswith("-"):
        raise UnknownNameError(f"{verb.name}'s part", following[0], parts)
    return verb


def _carry_out(verb: Verb, arguments: list[str]) -> int:
    from lerobot_demohlm.cli.parsing import parse

    try:
        module = importlib.import_module(verb.module)
        options = parse(module.Options, verb, arguments)
        return 0 if options is None else module.run(options) or 0
    except ModuleNotFoundError as error:
        extra = EXTRAS.get((error.name or "").split(".")[0])
        if extra is None:
            raise
        raise DemoHLMError(
            f"an installation without {error.name}",
            f"the extra [{extra}]",
            f'uv sync --extra {extra}, or pip install ".[{extra}]"',
        ) from error


def _print_completion(shells: list[str]) -> int:
    if len(shells) != 1 or shells[0] not in SHELLS:
        raise UnknownNameError("shell", " ".join(shells), SHELLS)
    from lerobot_demohlm.cli.completion import script

    print(script(shells[0]))
    return 0
