"""The record of a deployment: every slot with its age, what a kill or a full disk costs, and the page about it."""

import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from gym_demohlm.errors import DatasetError
from lerobot_demohlm.cli import main
from lerobot_demohlm.hardware import recorder, records
from lerobot_demohlm.hardware.deployment import FACTS
from lerobot_demohlm.hardware.recorder import ROWS, Recorder
from lerobot_demohlm.hardware.records import Mode
from lerobot_demohlm.reports.explain.deployment_page import explain_deployment
from tests.helpers.robot import until


def fill(folder: Path, mode: Mode, reason: str, number: int) -> None:
    rng = np.random.default_rng(number)
    control = records.record(
        "control", mode=mode, reason=reason.encode(), kp=100.0, kd=2.0, ticks=number, sent_q=rng.normal(size=29),
        policy_age_s=0.05, state_age_s=0.001, pose_age_s=0.02, changed=0b10,
    )  # fmt: skip
    records.slot(folder, "state").write(records.record("state", q=rng.normal(size=29), tick=number))
    records.slot(folder, "control").write(control)


def recorded(tmp_path: Path, count: int = 250) -> Path:
    """Return a record of a robot that stands, runs and holds."""
    made, root = Recorder(tmp_path, tmp_path / "record"), tmp_path / "record"
    for number in range(count):
        mode = (Mode.STAND, Mode.RUN, Mode.HOLD)[3 * number // count]
        fill(tmp_path, mode, "operator" if mode != Mode.HOLD else "policy silent for 0.301 s", number)
        made._rows.append(made._row())
        if len(made._rows) >= ROWS:
            made._write()
    made._write()
    facts = {"task": "LiftBox", "interface": "lo", "pose_source": "exact", "policy": "mlp", "mode": "HOLD"}
    (root / FACTS).write_text(json.dumps(facts | {"reason": "policy silent for 0.301 s"}))
    return root


def test_every_slot_is_there_with_its_age(tmp_path: Path) -> None:
    root = recorded(tmp_path)
    rows = recorder.read(root)
    assert rows.num_rows == 250 and len(list(root.glob("*.parquet"))) == 3
    for name in recorder.SLOTS:
        assert set(recorder.column_names(name)) <= set(rows.column_names)
    assert rows["state.tick"].to_pylist() == list(range(250))
    assert all(0.0 <= age < 60.0 for age in rows["state.slot_age_s"].to_pylist())
    assert np.isinf(rows["pose.slot_age_s"].to_pylist()).all(), "what never spoke is infinitely old"
    np.testing.assert_array_equal(rows["state.q"].to_pylist()[7], np.random.default_rng(7).normal(size=(2, 29))[1])


def test_the_page_says_what_happened_and_why(tmp_path: Path) -> None:
    root = recorded(tmp_path)
    page, short = explain_deployment(root)
    assert short["ended"] == "HOLD: policy silent for 0.301 s"
    assert [entry.split(" s ")[1] for entry in short["changes"]] == [
        "STAND: operator", "RUN: operator", "HOLD: policy silent for 0.301 s",
    ]  # fmt: skip
    assert page.count("<svg") == 5 and "policy silent for 0.301 s" in page
    output = tmp_path / "page.html"
    assert main(["explain", "--root", str(root), "--output", str(output)]) == 0
    assert output.read_text().startswith("<!doctype html>")


def test_a_record_without_rows_is_refused(tmp_path: Path) -> None:
    (tmp_path / FACTS).write_text("{}")
    with pytest.raises(DatasetError, match="cannot be read"):
        explain_deployment(tmp_path)


_RECORD = """
import sys
from pathlib import Path
from lerobot_demohlm.hardware.recorder import Recorder
Recorder(Path(sys.argv[1]), Path(sys.argv[1]) / "record").run()
"""


def test_a_full_disk_is_said_and_the_recorder_lives_on(tmp_path: Path) -> None:
    """The limit on files of the system, set on a recorder at work, fails its writes as a full disk does."""
    process = subprocess.Popen([sys.executable, "-c", _RECORD, str(tmp_path)])
    told, number = records.slot(tmp_path, "recorder"), 0

    def reading() -> np.void | None:
        nonlocal number
        number += 1
        fill(tmp_path, Mode.RUN, "operator", number)
        found = told.read()
        return None if found is None else found.value

    def written() -> bool:
        value = reading()
        return value is not None and int(value["rows"]) >= ROWS

    def failed() -> bool:
        value = reading()
        return value is not None and bool(value["failed"])

    try:
        until(written, 120.0)
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (0, 0))
        until(failed, 60.0)
        time.sleep(0.1)
        found = told.read()
        assert found is not None and records.text(found.value["reason"]) == "File too large"
        assert process.poll() is None
    finally:
        process.kill()
        process.wait()
    assert recorder.read(tmp_path / "record").num_rows >= ROWS, "what was written before is whole after a kill"


_PARENT = """
import multiprocessing, sys, time
from pathlib import Path
from types import SimpleNamespace
from lerobot_demohlm.hardware import processes
from lerobot_demohlm.hardware.recorder import Recorder

folder = Path(sys.argv[1])
settings = SimpleNamespace(root=folder / "record")
multiprocessing.get_context("fork").Process(target=processes.run_process, args=("recorder", settings, folder)).start()
time.sleep(600.0)
"""


def test_a_recorder_whose_parent_is_killed_writes_what_it_has(tmp_path: Path) -> None:
    parent = subprocess.Popen([sys.executable, "-c", _PARENT, str(tmp_path)])
    try:
        until(lambda: (tmp_path / "recorder.ready").exists(), 120.0)
        fill(tmp_path, Mode.RUN, "operator", 7)
        began = records.slot(tmp_path, "recorder")
        until(lambda: began.read() is not None, 60.0)
        time.sleep(0.5)
    finally:
        parent.kill()
        parent.wait()
    until(lambda: any((tmp_path / "record").glob("*.parquet")), 60.0)
    assert recorder.read(tmp_path / "record")["state.tick"].to_pylist() == [7]
