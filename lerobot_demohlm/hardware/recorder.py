"""Every slot with its age, at each tick of the controller -> Parquet files: a process of its own that nobody waits for.

A file holds two seconds and is whole once it has its name, so a recorder that is killed loses no more. One that cannot
write says so in its slot, and the watchdog holds the robot.
"""

import io
import multiprocessing
import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from gym_demohlm.files import replacing
from lerobot_demohlm.hardware import records

ROWS = 100  # a file: two seconds
SLOTS = ("control", "state", "policy", "pose", "servos", "operator")
PERIOD_S = 0.005
_TEXT = {"reason", "source"}


def column_names(name: str) -> list[str]:
    """Return the columns of a slot."""
    return [
        f"{name}.slot_number",
        f"{name}.slot_age_s",
        *(f"{name}.{field}" for field in records.RECORDS[name].names or ()),
    ]


class Recorder:
    """Writes what the slots hold.

    Args:
        folder: Of the slots.
        root: Directory of the files; made where it does not exist.
    """

    def __init__(self, folder: Path, root: Path) -> None:
        self._slots = {name: records.slot(folder, name) for name in records.RECORDS}
        self._root, self._stop = root, False
        root.mkdir(parents=True, exist_ok=True)
        self._rows: list[dict[str, Any]] = []
        self._files, self._total, self._bytes, self._failed = 0, 0, 0, ""
        pq.write_table(pa.Table.from_pylist([self._row()]), io.BytesIO(), compression="zstd")  # the first is slow

    def run(self) -> None:
        """Record until a signal asks for the end or the parent ends, and then what is left."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: setattr(self, "_stop", True))
        last, parent = 0, multiprocessing.parent_process()
        while not self._stop and (parent is None or parent.is_alive()):
            control = self._slots["control"].read()
            if control is not None and control.number != last:
                last = control.number
                self._rows.append(self._row())
            if len(self._rows) >= ROWS:
                self._write()
            self._tell()
            time.sleep(PERIOD_S)
        if self._rows:
            self._write()
        self._tell()

    def _row(self) -> dict[str, Any]:
        now_ns = time.monotonic_ns()
        row: dict[str, Any] = {"time_ns": now_ns}
        for name in SLOTS:
            reading = self._slots[name].read()
            value = np.zeros((), records.RECORDS[name])[()] if reading is None else reading.value
            row[f"{name}.slot_number"] = 0 if reading is None else reading.number
            row[f"{name}.slot_age_s"] = np.inf if reading is None else 1e-9 * (now_ns - reading.time_ns)
            for field in records.RECORDS[name].names or ():
                entry = value[field]
                if field in _TEXT:
                    row[f"{name}.{field}"] = records.text(entry)
                else:
                    row[f"{name}.{field}"] = np.asarray(entry).ravel().tolist() if np.ndim(entry) else entry.item()
        return row

    def _write(self) -> None:
        """Write a file; on failure say so and forget its rows, or memory would fill up too."""
        path = self._root / f"slots-{self._files:05d}.parquet"
        try:
            with replacing(path) as beside:
                pq.write_table(pa.Table.from_pylist(self._rows), beside, compression="zstd")
        except OSError as error:
            self._failed = os.strerror(error.errno) if error.errno else str(error)
        else:
            self._files += 1
            self._total += len(self._rows)
            self._bytes += path.stat().st_size
        self._rows = []

    def _tell(self) -> None:
        value = records.record(
            "recorder", rows=self._total, bytes=self._bytes, failed=bool(self._failed),
            reason=self._failed.encode()[: records.REASON_SIZE],
        )  # fmt: skip
        self._slots["recorder"].write(value)


def read(root: Path) -> pa.Table:
    """Return the rows of a recording, in their order.

    Raises:
        FileNotFoundError: There are none.
    """
    files = sorted(root.glob("slots-*.parquet"))
    if not files:
        raise FileNotFoundError(f"got no slots-*.parquet in {root}; expected a recording; check the path")
    return pa.concat_tables([pq.read_table(file) for file in files], promote_options="permissive")
