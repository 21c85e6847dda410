"""Worker processes that do not outlive the one that started them, and that do not repeat LeRobot's long warning."""

import logging
import multiprocessing
import os
import threading


def end_with_parent() -> None:
    """End this worker process when the one that started it ends, however it does: killed, it cannot say so."""
    hush_torchcodec()
    threading.Thread(target=_wait_and_end, daemon=True).start()


def hush_torchcodec() -> None:
    """Drop the warning, dozens of lines long, that LeRobot gives when torchcodec cannot be loaded.

    It is about decoding videos, of which these datasets have none. All other warnings stay.
    """
    logging.getLogger("lerobot.utils.import_utils").addFilter(_is_not_of_torchcodec)


def _is_not_of_torchcodec(record: logging.LogRecord) -> bool:
    return not ("'torchcodec'" in record.getMessage() and "decoder" in record.getMessage())


def _wait_and_end() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
