"""The doctor says what is wrong with a machine, what to do about it, and nothing where all is well."""

import json
from pathlib import Path
from typing import Any

import pytest

from gym_demohlm.envs import rendering
from gym_demohlm.errors import SceneError
from gym_demohlm.registry import get_task
from lerobot_demohlm.checks import doctor, portability
from lerobot_demohlm.checks.doctor import OK, REMARK, WRONG, Digest, DoctorOptions, Finding

PACKAGED = portability.packaged()


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Return the parts that the doctor is given in place of computed ones; a test may change them."""
    parts = dict(PACKAGED["parts"])
    monkeypatch.setattr(portability, "parts", lambda: parts)
    monkeypatch.setattr(portability, "behaviour", lambda task: PACKAGED["tasks"][task.name])
    monkeypatch.setattr(portability, "differing_versions", lambda: ())
    monkeypatch.setattr(doctor, "_environment", lambda: iter([Finding(subject="graphics", found="egl draws")]))
    return parts


@pytest.mark.usefixtures("quick")
def test_a_sound_machine(capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor.run(DoctorOptions()) == 0
    out = capsys.readouterr().out
    for name, value in PACKAGED["parts"].items():
        assert f"{name} " in out
        assert out.count(value[:12]) == 2  # packaged and this machine's
    assert out.splitlines()[-1] == "all well"


def test_other_bits_are_wrong_under_equal_versions(
    quick: dict[str, str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    quick["physics"] = "0" * 64
    assert doctor.run(DoctorOptions()) == 1
    out = capsys.readouterr().out
    assert "WRONG" in out and "other bits in: physics" in out and "Reinstall" in out
    monkeypatch.setattr(portability, "differing_versions", lambda: ("mujoco 3.11.0 then, 3.12.0 now",))
    assert doctor.run(DoctorOptions()) == 0
    out = capsys.readouterr().out
    assert "remark" in out and "mujoco 3.11.0 then, 3.12.0 now" in out and "within bounds" in out


@pytest.mark.usefixtures("quick")
def test_it_writes_digests_and_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = DoctorOptions(tasks=True, write=tmp_path / "digests.json", append=tmp_path / "portability.jsonl")
    assert doctor.run(options) == 0
    written = json.loads((tmp_path / "digests.json").read_text())
    assert written["parts"] == PACKAGED["parts"]
    assert written["tasks"] == PACKAGED["tasks"]
    assert list(written["tasks"]) == list(PACKAGED["tasks"])
    line = json.loads((tmp_path / "portability.jsonl").read_text())
    assert line["equal"] is True
    assert line["digests"] == PACKAGED["parts"] | PACKAGED["tasks"]
    assert line["versions"].keys() == PACKAGED["versions"].keys()
    assert "LiftBox" in capsys.readouterr().out


def test_what_it_writes_it_reads(tmp_path: Path, quick: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    quick["attempt"] = "1" * 64
    doctor.write_digests(tmp_path / "digests.json")
    monkeypatch.setattr(portability, "PACKAGED", tmp_path / "digests.json")
    assert portability.packaged()["parts"]["attempt"] == "1" * 64


def test_graphics_are_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = doctor.graphics()
    assert drawn.level == OK
    assert "draws" in drawn.found

    def refuse(*_: Any) -> None:
        raise SceneError("no graphics to draw with", "EGL or OSMesa", "install them")

    monkeypatch.setattr(rendering.Renderer, "_open", refuse)
    missing = doctor.graphics()
    assert missing.level == WRONG
    assert "install them" in missing.found


def test_missing_things_have_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda _: None)
    for finding in doctor.extras():
        assert finding.level == REMARK
        assert "uv sync --extra" in finding.remedy
    assert doctor.plugin().level == WRONG
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 1e9}))
    disk = doctor.space()[0]
    assert (disk.level, disk.found) == (REMARK, "1 GB, less than 5 GB")


def test_the_machine_is_described() -> None:
    found = doctor.processor()
    assert found["cores"] >= 1
    assert found["kind"] == portability.provenance.cpu_family()
    assert set(found["features"]) <= set(doctor.FEATURES)
    assert doctor.versions()["lerobot"].startswith("0.6")
    assert doctor.plugin().level == OK
    assert doctor.video().level == OK


def test_a_digest_beside_the_packaged_one() -> None:
    assert Digest(name="physics", packaged="a", here="a").equal
    assert not Digest(name="physics", packaged="a", here="b").equal
    assert get_task("LiftBox").name in PACKAGED["tasks"]
