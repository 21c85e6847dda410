"""Files that are whole or not there, whenever the process that writes them is killed."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield the path of a new file beside ``path``; what is written there takes its place at the end of the block.

    An error or a kill within the block leaves the old file as it was. An error also removes the new one.

    Raises:
        OSError: The new file cannot be written; it names ``path``.
    """
    path = Path(path)
    beside = path.with_name(f".{path.name}.partial")
    try:
        yield beside
        beside.replace(path)
    except BaseException as error:
        if isinstance(error, OSError) and error.filename == str(beside):
            error.filename = str(path)
        with suppress(OSError):
            beside.unlink()
        raise


def replace_text(path: Path, text: str) -> None:
    """Write a text file, or write over an old one, whole."""
    with replacing(path) as beside:
        beside.write_text(text)
