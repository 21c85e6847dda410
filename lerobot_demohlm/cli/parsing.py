"""A verb's dataclass and the words after the verb -> its options, or one line that says what is wrong.

tyro turns fields into flags and attribute docs into help. ``flags_of`` lists the same flags as plain data, for the
reference in docs/cli.md and for naming the nearest of them.
"""

import contextlib
import dataclasses
import io
import re
import sys
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Union

import docstring_parser
import tyro

from gym_demohlm.errors import DemoHLMError, UnknownNameError
from lerobot_demohlm.cli.verbs import Verb

MARKERS = (tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone)
"""``--resume`` has no ``--no-resume`` beside it, and nobody writes ``--steps None``."""
_WORDS = {str: "TEXT", int: "INT", float: "FLOAT", Path: "PATH"}


class UsageError(DemoHLMError):
    """Options that do not fit their verb.

    Args:
        wrong: What is wrong with them.
        verb: The verb's name.
    """

    def __init__(self, wrong: str, verb: str) -> None:
        Exception.__init__(self, f"{wrong}; see `demohlm {verb} --help`")


@dataclass(frozen=True, kw_only=True)
class Flag:
    """One option of a verb.

    Attributes:
        name: As it is written, ``--num-workers``, or the name of a positional argument.
        value: What follows it, such as ``INT`` or ``mlp|act``; empty where nothing does.
        several: Whether more than one value may follow.
        required: Whether there is no default.
        default: The default; None where it has to be given or is not a value.
        fallback: What happens without it, in words, where that is more than the default says.
        group: Title of the group of which only one may be given; empty without one.
        group_required: Whether one of that group has to be given.
        help: Its attribute doc.
    """

    name: str
    value: str
    several: bool
    required: bool
    default: Any
    fallback: str | None
    group: str
    group_required: bool
    help: str


def default(text: str) -> object:
    """Return an annotation that says what happens where an option is not given; for options whose default is None."""
    return tyro.conf.arg(help_behavior_hint=f"(default: {text})")


def parse(options: type, verb: Verb, arguments: list[str]) -> Any:  # noqa: ANN401
    """Return the options that arguments stand for; None where help was asked for and has been printed.

    Args:
        options: The verb's dataclass.
        verb: What is called.
        arguments: What follows the verb's name.

    Raises:
        UnknownNameError: No such option.
        UsageError: An option is missing, excludes another, or has a wrong value.
    """
    flags = list(flags_of(options))
    given = _given(flags, verb, arguments)
    if not {"-h", "--help"} & set(arguments):
        _check_missing(flags, verb, given)
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            found = tyro.cli(
                options,
                prog=f"demohlm {verb.name}",
                description=f"{verb.sentence}\n\nExample: {verb.example}",
                args=arguments,
                config=MARKERS,
            )
    except SystemExit as end:
        if not end.code:
            return None
        wrong = _message(said.getvalue())
        if wrong.startswith("Missing from"):  # options are looked for above
            wrong = f"got no {' and no '.join(flag.name.upper() for flag in flags if not flag.name.startswith('-'))}"
        raise UsageError(wrong, verb.name) from None
    sys.stderr.write(said.getvalue())
    for flag in flags:
        empty = flag.several and getattr(found, flag.name.removeprefix("--").replace("-", "_")) == ()
        if empty and flag.name in given:
            raise UsageError(f"no value after {flag.name}", verb.name)
    return found


def flags_of(options: type) -> Iterator[Flag]:
    """Yield the flags that a verb's dataclass stands for, those of dataclasses in it among them."""
    docs = {
        entry.arg_name: entry.description or ""
        for base in reversed(options.__mro__)
        if dataclasses.is_dataclass(base)
        for entry in docstring_parser.parse_from_object(base).params
    }
    hints = typing.get_type_hints(options, include_extras=True)
    for field in dataclasses.fields(options):
        kind, marks = _unwrap(hints[field.name])
        if tyro.conf.Suppress in marks or tyro.conf.Fixed in marks:
            continue
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            yield from flags_of(kind)
            continue
        value, several = _value(kind)
        start = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
        hint = next((mark.help_behavior_hint for mark in marks if hasattr(mark, "help_behavior_hint")), None)
        group = next((mark for mark in marks if hasattr(mark, "title") and hasattr(mark, "required")), None)
        yield Flag(
            name=field.name if tyro.conf.Positional in marks else f"--{field.name.replace('_', '-')}",
            value=value,
            several=several,
            required=start is dataclasses.MISSING,
            default=None if start is dataclasses.MISSING else start,
            fallback=hint.removeprefix("(default: ").removesuffix(")") if hint else None,
            group=group.title if group else "",
            group_required=bool(group and group.required),
            help=" ".join(docs.get(field.name, "").split()),
        )


def _given(flags: list[Flag], verb: Verb, arguments: list[str]) -> list[str]:
    """Return the flags that are given, in the order of the dataclass."""
    found = set()
    known = [flag.name for flag in flags if flag.name.startswith("-")]
    for word in arguments:
        name = word.partition("=")[0].replace("_", "-")
        if not name.startswith("--") or name in (*known, "--help"):
            found.add(name)
            continue
        if name in verb.moved:
            raise DemoHLMError(
                f"{name} with `demohlm {verb.name}`",
                f"the verb it has become: `demohlm {verb.moved[name]}`",
                f"see `demohlm {verb.moved[name].partition(' --')[0]} --help`",
            )
        raise UnknownNameError(f"option of `demohlm {verb.name}`", name, known)
    return [name for name in known if name in found]


def _check_missing(flags: list[Flag], verb: Verb, given: list[str]) -> None:
    missing = [flag for flag in flags if flag.required and flag.name.startswith("-") and flag.name not in given]
    if missing:
        wanted = ", ".join(f"{flag.name} {flag.value}" for flag in missing)
        raise UsageError(f"got no {' and no '.join(flag.name for flag in missing)}; expected {wanted}", verb.name)
    for group in dict.fromkeys(flag.group for flag in flags if flag.group):
        members = [flag for flag in flags if flag.group == group]
        chosen = [flag.name for flag in members if flag.name in given]
        names = " or ".join(flag.name for flag in members)
        if len(chosen) > 1:
            raise UsageError(f"got {' and '.join(chosen)}; expected one of them", verb.name)
        if not chosen and members[0].group_required:
            raise UsageError(f"got no {names}; expected one of them", verb.name)


def _unwrap(hint: Any) -> tuple[Any, tuple[Any, ...]]:  # noqa: ANN401
    """Return a type without its annotations, and these."""
    if typing.get_origin(hint) is typing.Annotated:
        kind, *marks = typing.get_args(hint)
        return kind, tuple(marks)
    return hint, ()


def _value(kind: Any) -> tuple[str, bool]:  # noqa: ANN401
    """Return what follows a flag of some type, and whether several of it may."""
    if typing.get_origin(kind) in (Union, types.UnionType):
        kind = next(part for part in typing.get_args(kind) if part is not type(None))
    several = typing.get_origin(kind) is tuple
    if several:
        kind = typing.get_args(kind)[0]
    if typing.get_origin(kind) is Literal:
        return "|".join(map(str, typing.get_args(kind))), several
    return ("" if kind is bool else _WORDS[kind]), several


def _message(box: str) -> str:
    """Return the first paragraph below the title of what tyro has written into a box on stderr, in one line.

    Paragraphs are divided by rules. Where the output cannot show the characters of a box, there are only rules.
    """
    paragraphs: list[list[str]] = [[]]
    for line in box.splitlines():
        text = line.strip(" │").removeprefix("• ")
        if line.startswith(("╭", "╰")) or not text.strip("─-"):
            paragraphs.append([])
        else:
            paragraphs[-1].append(text)
    found = [" ".join(paragraph) for paragraph in paragraphs if paragraph]
    title = 0 if box.startswith("╭") else 1
    return re.sub(r" ([.,)])", r"\1", found[title] if title < len(found) else " ".join(found)).rstrip(".")


def only[T](kind: type[T], options: Any) -> T:  # noqa: ANN401
    """Return the fields of a verb's options that are those of a dataclass of the library, as an instance of that."""
    assert dataclasses.is_dataclass(kind)
    return kind(**{field.name: getattr(options, field.name) for field in dataclasses.fields(kind)})


def spelled(verb: str, options: Any, leave_out: tuple[str, ...] = ()) -> str:  # noqa: ANN401
    """Return the call that gives these options, without those left at their defaults.

    Args:
        verb: Its name.
        options: An instance of its dataclass.
        leave_out: Names of fields that are of no concern.
    """
    words = [f"demohlm {verb}"]
    for flag in sorted(flags_of(type(options)), key=lambda flag: flag.name.startswith("-")):
        name = flag.name.removeprefix("--").replace("-", "_")
        value = getattr(options, name)
        if name in leave_out or (not flag.required and value in (flag.default, ())):
            continue
        if flag.name.startswith("-"):
            words.append(flag.name)
        if flag.value:
            words += map(str, value) if flag.several else [str(value)]
    return " ".join(words)
