"""A controller is adopted after all checks, which are made once each; one that falls short changes nothing."""

import hashlib
import importlib.util
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from gym_demohlm import jsonl
from gym_demohlm.control import controllers
from gym_demohlm.control.whole_body import DEFAULT_WEIGHTS, WEIGHTS_FOLDER
from gym_demohlm.errors import NoSuccessError, SceneError
from gym_demohlm.registry import get_task
from lerobot_demohlm.adoption import adopt, steps
from lerobot_demohlm.adoption.adopt import FOUND, NotAdoptedError
from lerobot_demohlm.adoption.steps import Found, Request
from lerobot_demohlm.checks import lint
from lerobot_demohlm.cli import adopt_controller, main
from lerobot_demohlm.cli.verbs import VERBS
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.reproducibility import provenance


def _limp(path: Path) -> Path:
    """Write a controller whose policy does nothing."""
    arrays = dict(np.load(DEFAULT_WEIGHTS))
    last = json.loads(arrays["metadata"].tobytes())["layers"] - 1
    arrays[f"weight_{last}"], arrays[f"bias_{last}"] = 0 * arrays[f"weight_{last}"], 0 * arrays[f"bias_{last}"]
    np.savez(path, allow_pickle=False, **arrays)
    return path


def _tree(root: Path) -> dict[str, str]:
    return {
        path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def test_a_worse_controller_changes_nothing_and_is_told_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = _tree(WEIGHTS_FOLDER), _tree(demonstrations.default_root(get_task("LiftBox")).parent)
    call = ["adopt-controller", str(_limp(tmp_path / "limp.npz")), "--work", str(tmp_path / "work")]
    assert main([*call, "--num-robots", "8", "--seconds", "3", "--num-workers", "1"]) == 1
    said = capsys.readouterr().out
    assert "survival" in said
    assert json.loads(said.splitlines()[-1])["adopted"] is False
    assert before == (_tree(WEIGHTS_FOLDER), _tree(demonstrations.default_root(get_task("LiftBox")).parent))
    (line,) = jsonl.read(tmp_path / "work" / FOUND)
    assert line["check"] == "benchmark"


def test_a_benchmark_in_which_nothing_is_measured_falls_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unknown = steps.paired.Row(name="velocity", new=np.nan, old=np.nan, low=np.nan, high=np.nan)
    monkeypatch.setattr(steps, "_tried", lambda *_: None)
    monkeypatch.setattr(steps.paired, "compare", lambda *_: [unknown])
    found = steps.benchmark(Request(weights=DEFAULT_WEIGHTS, work=tmp_path, seconds=1.0))
    assert found.failures == ("velocity: nothing was measured in 1 s, expected a number; give --seconds",)


def test_a_task_without_a_success_falls_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: object) -> None:
        raise NoSuccessError("no success in 4 attempts (timeout 4)", "one or more", "look at them")

    monkeypatch.setattr(steps, "generate", fail)
    found = steps.attempt(Request(weights=DEFAULT_WEIGHTS, work=tmp_path, num_attempts=4), "LiftBox")
    assert "no success in 4 attempts" in found.failures[0]


def test_findings_hold_for_the_code_that_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = Request(weights=DEFAULT_WEIGHTS, work=tmp_path).key
    assert Request(weights=DEFAULT_WEIGHTS, work=tmp_path).key == before
    monkeypatch.setattr(provenance, "checker_hash", lambda: "other")
    assert Request(weights=DEFAULT_WEIGHTS, work=tmp_path).key != before


@pytest.mark.parametrize("content", [b"", b"not a zip", DEFAULT_WEIGHTS.read_bytes()[:2000]])
def test_a_damaged_file_is_refused_before_anything_is_made(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.npz"
    path.write_bytes(content)
    with pytest.raises(SceneError, match="cannot be read"):
        adopt.check(Request(weights=path, work=tmp_path / "work"))
    assert not (tmp_path / "work").exists()


def test_a_killed_call_makes_each_check_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def planned(_: Request) -> list:
        def one(name: str) -> Found:
            made.append(name)
            if name == "lint" and made.count("lint") == 1:
                raise KeyboardInterrupt
            return Found(numbers={})

        return [(name, lambda name=name: one(name)) for name in ("benchmark", "lint", "generation")]

    monkeypatch.setattr(adopt, "plan", planned)
    request = Request(weights=DEFAULT_WEIGHTS, work=tmp_path / "work")
    with pytest.raises(KeyboardInterrupt):
        adopt.check(request)
    assert len(adopt.check(request)) == 3
    assert made == ["benchmark", "lint", "lint", "generation"]
    adopt.check(Request(weights=DEFAULT_WEIGHTS, work=tmp_path / "work", seed=1))  # nothing is known of this one
    assert len(made) == 7


def test_what_fell_short_falls_short_again_without_being_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []

    def short() -> Found:
        made.append(1)
        return Found(numbers={}, failures=("LiftBox: 96 of 100",))

    monkeypatch.setattr(adopt, "plan", lambda _: [("generation LiftBox", short)])
    for _ in range(2):
        with pytest.raises(NotAdoptedError, match="96 of 100"):
            adopt.check(Request(weights=DEFAULT_WEIGHTS, work=tmp_path / "work"))
    assert len(made) == 1


def test_what_follows_a_switch_is_made_again_without_the_checks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A call that was killed after the switch: the controller is the default one already."""
    calls: list[list[str]] = []
    monkeypatch.setattr(adopt_controller.subprocess, "run", lambda call, check: calls.append(call[1:]))
    words = ["adopt-controller", str(DEFAULT_WEIGHTS), "--work", str(tmp_path / "work"), "--docs", str(tmp_path)]
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["adopted"] is True
    assert not (tmp_path / "work").exists()
    assert [call[1] for call in calls] == ["lerobot_demohlm.adoption.digests", *["lerobot_demohlm.cli"] * 2]
    assert importlib.util.find_spec(calls[0][1]) is not None
    for _, _, *arguments in calls[1:]:
        verb = next(verb for verb in reversed(VERBS) if tuple(arguments[: len(verb.words)]) == verb.words)
        assert verb.name in ("benchmark controller figures", "results")


@pytest.mark.parametrize("killed_at", [None, "install", "copytree", "rename", "make_default"])
def test_a_switch_that_was_killed_is_completed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, killed_at: str | None
) -> None:
    packaged, weights, work = tmp_path / "packaged", tmp_path / "weights", tmp_path / "work"
    shutil.copytree(WEIGHTS_FOLDER, weights)
    new = _limp(tmp_path / "new.npz")
    request = Request(weights=new, work=work)
    for name in ("lift_box", "push_cube"):
        for root, text in ((packaged, "old"), (request.demonstrations, "new")):
            (root / name / "meta").mkdir(parents=True)
            (root / name / "meta" / "demonstration.json").write_text(text)
    monkeypatch.setattr(demonstrations, "_PACKAGED", packaged)
    monkeypatch.setattr(adopt, "packaged_tasks", lambda: ["LiftBox", "PushCube"])
    calls: list[str] = []

    def kill(name: str, original):  # noqa: ANN001, ANN202
        def killed(*args, **kwargs):  # noqa: ANN002, ANN003, ANN202
            calls.append(name)
            if len(calls) == 2 or (len(calls) == 1 and name in ("install", "make_default")):
                raise KeyboardInterrupt
            return original(*args, **kwargs)

        return killed

    with monkeypatch.context() as patch:
        owner = {"install": controllers, "make_default": controllers, "copytree": shutil, "rename": Path}
        if killed_at is not None:
            patch.setattr(owner[killed_at], killed_at, kill(killed_at, getattr(owner[killed_at], killed_at)))
            with pytest.raises(KeyboardInterrupt):
                adopt.switch(request, weights)
            assert (weights / "default.txt").read_text().strip() == DEFAULT_WEIGHTS.stem  # it comes last
    name = adopt.switch(request, weights)
    assert controllers.find("default", weights).read_bytes() == new.read_bytes()
    assert (weights / "default.txt").read_text().strip() == name
    assert sorted(path.name for path in packaged.iterdir()) == ["lift_box", "push_cube"]
    assert set(_tree(packaged).values()) == {hashlib.sha256(b"new").hexdigest()}


def test_weights_that_changed_since_they_were_checked_are_not_installed(tmp_path: Path) -> None:
    request = Request(weights=_limp(tmp_path / "new.npz"), work=tmp_path / "work")
    assert request.key
    shutil.copy(DEFAULT_WEIGHTS, request.weights)
    with pytest.raises(adopt.NotAdoptedError, match=r"new\.npz, which has changed"):
        adopt.switch(request, tmp_path / "weights")
    assert not (tmp_path / "weights").exists()


@pytest.mark.parametrize(("bad_seeds", "falls_short"), [([7000], False), ([7000, 7002], True), ([7001, 7002], False)])
def test_a_lint_that_fails_once_in_three_is_chance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bad_seeds: list[int], falls_short: bool
) -> None:
    seeds: list[int] = []

    def lint_with(_task: object, _made: object, settings: lint.Settings) -> list[lint.Check]:
        seeds.append(settings.seed)
        ok = settings.seed not in bad_seeds
        return [lint.Check(name="depth", got="8 mm", expected="5 mm or less", ok=ok, number=8.0)]

    monkeypatch.setattr(steps.lint, "lint", lint_with)
    monkeypatch.setattr(steps.demonstrations, "load", lambda *_: None)
    found = steps.check_task(Request(weights=DEFAULT_WEIGHTS, work=tmp_path), "LiftBox")
    assert bool(found.failures) == falls_short
    assert seeds == ([7000, 7001, 7002] if 7000 in bad_seeds else [7000])
