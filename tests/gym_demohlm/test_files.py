"""Files that are whole or not there."""

from pathlib import Path

import pytest

from gym_demohlm.files import replace_text, replacing


@pytest.mark.parametrize("old", [None, "old"])
@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path: Path, old: str | None, error: type[Exception]) -> None:
    path = tmp_path / "card.md"
    if old is not None:
        path.write_text(old)
    with pytest.raises(error), replacing(path) as beside:
        beside.write_text("half")
        raise error
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == ({} if old is None else {"card.md": old})


def test_the_old_file_is_there_until_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "card.md"
    replace_text(path, "old")
    with replacing(path) as beside:
        beside.write_text("new")
        assert path.read_text() == "old"
        assert beside.parent == path.parent, "a rename between disks is not whole at once"
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("card.md", "new")]


def test_an_error_names_the_file_and_not_the_one_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "card.md"
    with pytest.raises(FileNotFoundError) as caught:
        replace_text(path, "new")
    assert caught.value.filename == str(path)
