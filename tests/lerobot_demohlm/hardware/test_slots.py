"""Latest-value slots: what is read is whole, and grows old when its writer is killed."""

import multiprocessing
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from lerobot_demohlm.hardware import records
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.slots import Slot
from tests.helpers.robot import until

PAIR = np.dtype([("a", "<u8", 200), ("b", "<u8", 200)])


def pair(number: int) -> np.void:
    value = np.zeros((), PAIR)
    value["a"], value["b"] = number, number
    return value[()]


def test_the_newest_value_is_read_with_its_age(tmp_path: Path) -> None:
    writer, reader = Slot(tmp_path / "s", PAIR), Slot(tmp_path / "s", PAIR)
    assert reader.read() is None and reader.age_s() == np.inf
    writer.write(pair(1), time.monotonic_ns() - 3_000_000_000)
    writer.write(pair(2), time.monotonic_ns() - 2_000_000_000)
    found = reader.read()
    assert found is not None and found.number == 2 and (found.value["a"] == 2).all()
    assert 2.0 <= found.age_s < 60.0


def test_a_slot_of_another_size_is_refused(tmp_path: Path) -> None:
    Slot(tmp_path / "s", PAIR)
    with pytest.raises(RobotError, match="one version"):
        Slot(tmp_path / "s", np.dtype([("a", "<u8")]))


def _write_forever(path: Path) -> None:
    slot, number = Slot(path, PAIR), 0
    while True:
        number += 1
        slot.write(pair(number))


def test_no_torn_value_is_read_and_a_killed_writer_leaves_the_last_one(tmp_path: Path) -> None:
    path = tmp_path / "s"
    process = multiprocessing.get_context("spawn").Process(target=_write_forever, args=(path,), daemon=True)
    process.start()
    reader = Slot(path, PAIR)
    until(lambda: reader.read() is not None, 60.0)
    last = 0
    for _ in range(3000):
        found = reader.read()
        if found is None:  # overtaken every time: allowed, as nothing wrong is said
            continue
        assert (found.value["a"] == found.value["a"][0]).all() and (found.value["b"] == found.value["a"]).all()
        assert int(found.value["a"][0]) >= last
        last = int(found.value["a"][0])
    assert last > 0 and process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    after = reader.read()
    assert after is not None and (after.value["a"] == after.value["b"]).all()
    assert reader.read().number == after.number  # pyright: ignore[reportOptionalMemberAccess]


@pytest.mark.parametrize("name", records.RECORDS)
def test_every_record_goes_through_its_slot(name: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    dtype = records.RECORDS[name]
    value = np.frombuffer(rng.integers(0, 2, dtype.itemsize, dtype=np.uint8).tobytes(), dtype)[0]
    records.slot(tmp_path, name).write(value)
    found = records.slot(tmp_path, name).read()
    assert found is not None and found.value.tobytes() == value.tobytes()
