"""JSON lines: what is written is read, files stay readable, and an error names file and line."""

import dataclasses
from pathlib import Path

import pytest

from gym_demohlm import jsonl
from gym_demohlm.errors import DatasetError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Point:
    """A line of a file."""

    name: str
    x: float
    seen: bool = False
    labels: dict[str, int] | None = None

    def __post_init__(self) -> None:
        if self.x < 0:
            raise ValueError("got x < 0")


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path, points = (
        tmp_path / "new" / "points.jsonl",
        [Point(name="a\u2028b", x=1.5, labels={"k": 1}), Point(name="c", x=2)],
    )
    jsonl.append(path, map(dataclasses.asdict, points[:1]))
    jsonl.append(path, map(dataclasses.asdict, points[1:]))
    assert jsonl.read_as(Point, path) == points
    jsonl.write(path, [{"name": "d", "x": 3, "of_another_version": 1}])
    assert jsonl.read_as(Point, path) == [Point(name="d", x=3)], "an unknown key is left out, a default filled in"


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("[1]", r"points\.jsonl:2 with \[1\]"),
        ("{", r"points\.jsonl:2 \("),
        ("", r"points\.jsonl:2 \("),
        ('{"name": "a"}', r"points\.jsonl:2 without x"),
        ('{"name": 1, "x": 1}', r"points\.jsonl:2 with name=1; expected str"),
        ('{"name": "a", "x": true}', r"points\.jsonl:2 with x=True; expected float or int"),
        ('{"name": "a", "x": 1, "seen": 1}', r"points\.jsonl:2 with seen=1; expected bool"),
        ('{"name": "a", "x": -1}', r"points\.jsonl:2 \(got x < 0\)"),
    ],
)
def test_an_error_names_file_and_line(line: str, error: str, tmp_path: Path) -> None:
    path = tmp_path / "points.jsonl"
    path.write_text('{"name": "a", "x": 1}\n' + line + "\n")
    with pytest.raises(DatasetError, match=error):
        jsonl.read_as(Point, path)


def test_a_torn_last_line_is_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "points.jsonl"
    path.write_text('{"name": "a", "x": 1}\n{"name": "b", ')
    assert jsonl.resume(Point, path) == [Point(name="a", x=1)]
    assert path.read_text() == '{"name": "a", "x": 1}\n'
    for torn in ('{"na', '{"name": "b", "x'):
        path.write_text(torn)
        assert jsonl.resume(Point, path) == []
        assert path.read_text() == ""


@pytest.mark.parametrize("text", ['{"notes": "mine"}', '{"notes": 1}\n{"name": "b", ', "notes", "notes\n", "\xff"])
def test_a_file_of_something_else_is_not_cut(text: str, tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_bytes(text.encode("latin1"))
    with pytest.raises(DatasetError, match=r"notes\.txt"):
        jsonl.resume(Point, path)
    assert path.read_bytes() == text.encode("latin1")


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="check the path"):
        jsonl.read(tmp_path / "nothing.jsonl")


def test_a_line_without_its_end_costs_none_that_is_appended(tmp_path: Path) -> None:
    """A process was killed in the middle of a line: the next one's lines are whole, and its own is named."""
    path = tmp_path / "lines.jsonl"
    path.write_text('{"a": 1}\n{"a": 2, "b')
    jsonl.append(path, [{"a": 3}, {"a": 4}])
    assert path.read_text() == '{"a": 1}\n{"a": 2, "b\n{"a": 3}\n{"a": 4}\n'
    jsonl.append(tmp_path / "new" / "lines.jsonl", [{"a": 1}])
    assert (tmp_path / "new" / "lines.jsonl").read_text() == '{"a": 1}\n'
