"""Files of JSON lines <-> mappings and frozen dataclasses; an error names the file and the line."""

import dataclasses
import functools
import json
import types
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from gym_demohlm.errors import DatasetError

Line = dict[str, Any]


def read(path: Path) -> list[Line]:
    """Return the lines of a file, each a JSON object.

    Raises:
        DatasetError: There is no such file, it cannot be read, or a line is not a JSON object.
    """
    path = Path(path)
    try:
        texts = path.read_text().split("\n")  # splitlines() would also split at separators inside of a string
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path} ({error})", "a file of JSON lines", "check the path") from error
    if texts[-1] == "":
        texts.pop()
    return [_object(text, f"{path}:{number}") for number, text in enumerate(texts, start=1)]


def _object(text: str, where: str) -> Line:
    try:
        line = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{where} ({error})", "a JSON object on each line", "mend or delete the line") from error
    if not isinstance(line, dict):
        raise DatasetError(f"{where} with {text[:40]}", "a JSON object on each line", "mend or delete the line")
    return line


def read_as[T](kind: type[T], path: Path) -> list[T]:
    """Return the lines of a file as dataclasses.

    Raises:
        DatasetError: As ``read``, or a line lacks a field, or has one of another type.
    """
    return [parse(kind, line, f"{path}:{number}") for number, line in enumerate(read(path), start=1)]


def parse[T](kind: type[T], line: Mapping[str, Any], where: str) -> T:
    """Return a dataclass with the values of a JSON object; keys that are no field of it are left out.

    Args:
        kind: The dataclass.
        line: The JSON object.
        where: File and line, for the error.

    Raises:
        DatasetError: A field without a default is missing, a value has another type, or the dataclass refuses it.
    """
    wanted, required = _fields(kind)
    for name, accepted in wanted.items():
        if name in line and not _is_of(line[name], accepted):
            raise DatasetError(
                f"{where} with {name}={line[name]!r}",
                " or ".join(one.__name__ for one in accepted),
                "mend or delete the line",
            )
    missing = [name for name in required if name not in line]
    if missing:
        raise DatasetError(f"{where} without {', '.join(missing)}", f"a {kind.__name__}", "mend or delete the line")
    try:
        return kind(**{name: line[name] for name in wanted if name in line})
    except ValueError as error:
        raise DatasetError(f"{where} ({error})", f"a {kind.__name__}", "mend or delete the line") from error


@functools.cache
def _fields(kind: type) -> tuple[dict[str, tuple[type, ...]], tuple[str, ...]]:
    """Return the accepted types of each field of a dataclass, and the fields without a default."""
    hints, fields = typing.get_type_hints(kind), dataclasses.fields(kind)
    absent = dataclasses.MISSING
    required = tuple(field.name for field in fields if field.default is absent and field.default_factory is absent)
    return {field.name: _types(hints[field.name]) for field in fields}, required


def _types(hint: Any) -> tuple[type, ...]:  # noqa: ANN401
    """Return the classes that a type hint stands for: those of a union, and those of containers without contents."""
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        return tuple(one for part in typing.get_args(hint) for one in _types(part))
    origin = typing.get_origin(hint) or hint
    if origin is Any:
        return (object,)
    if origin is typing.Literal:
        return tuple({type(value) for value in typing.get_args(hint)})
    return (origin, int) if origin is float else (origin,)


def _is_of(value: object, accepted: tuple[type, ...]) -> bool:
    if isinstance(value, bool):  # an int to Python, but not a number to JSON
        return bool in accepted or object in accepted
    return isinstance(value, accepted)


def encode(line: Mapping[str, Any]) -> str:
    """Return a JSON object as a line with its end."""
    return json.dumps(line) + "\n"


def write(path: Path, lines: Iterable[Mapping[str, Any]]) -> None:
    """Write a new file, or write over an old one."""
    Path(path).write_text("".join(map(encode, lines)))


def append(path: Path, lines: Iterable[Mapping[str, Any]]) -> None:
    """Append lines to a file, each handed to the system as soon as it comes; file and folder are made if missing.

    A line whose end a kill or a full disk has cut off stays as it is, on a line of its own.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+") as file:
        if not _ends_whole(path):
            file.write("\n")
        for line in lines:
            file.write(encode(line))
            file.flush()


def _ends_whole(path: Path) -> bool:
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - 1))
        return file.read(1) in (b"", b"\n")


def resume[T](kind: type[T], path: Path) -> list[T]:
    """Return the lines of a file that a process may have left when it was killed, and cut off one without its end.

    Args:
        kind: The dataclass that each line holds.
        path: The file. It is changed only where what it holds is such lines.

    Raises:
        DatasetError: As ``read_as``, or all that it holds is the beginning of something else.
    """
    path = Path(path)
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    found = [
        parse(kind, _object(text, f"{path}:{number}"), f"{path}:{number}")
        for number, text in enumerate(content[:whole].decode(errors="replace").split("\n")[:-1], start=1)
    ]
    torn, begins = content[whole:], f'{{"{dataclasses.fields(kind)[0].name}": '.encode()  # pyright: ignore[reportArgumentType]
    if torn:
        if not found and not (torn.startswith(begins) or begins.startswith(torn)):
            got, expected = (
                f"{path} with {torn[:40].decode(errors='replace')}",
                f"lines that hold a {kind.__name__} each",
            )
            raise DatasetError(got, expected, "check the path")
        with path.open("r+b") as file:
            file.truncate(whole)
    return found
