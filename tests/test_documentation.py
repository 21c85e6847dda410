"""README and docs: short, whole, and true. Their links lead somewhere and their commands and snippets run."""

import re
import subprocess
from pathlib import Path

import pytest

from lerobot_demohlm import cli
from tests.helpers import documented
from tests.helpers.paths import REPOSITORY, tracked

MIB = 2**20
DOCS = REPOSITORY / "docs"
PAGES = (REPOSITORY / "README.md", *sorted(path for path in tracked() if path.parent == DOCS and path.suffix == ".md"))
NOT_RUN = {
    "controller.md": "training and measuring a controller takes hours; tests/gym_demohlm/wbc does both in small",
    "results.md": "the commands that made the committed results, most of which took hours",
    "deployment.md": "they wait for a person or a robot; tests of hardware run them with a simulated one",
    "teleoperation.md": "they wait for a person; tests of teleop/web and devices run them with an emulated one",
    "cli.md": "the help of every verb: tests/lerobot_demohlm/cli compares it",
}
"""Pages whose bash blocks no test runs, and why; their flags are checked all the same."""
NEEDED = {
    "benchmark.md": "demohlm generate --task LiftBox --num-attempts 3 --root data/lift_box\n"
    "demohlm train --root data/lift_box --output outputs/lift_box\n",
    "variation.md": "demohlm generate --task GraspCube --num-attempts 3 --root data/grasp_cube\n"
    "demohlm train --root data/grasp_cube --output outputs/grasp_cube\n",
    "policies.md": "demohlm generate --task LiftBox --num-attempts 3 --root data/lift_box\n",
    "trials.md": "demohlm generate --task GraspCube --num-attempts 3 --root data/grasp_cube\n",
}
"""What a reader of a page has done before."""
TO_RUN = [page for page in PAGES if page.name not in NOT_RUN and documented.blocks(page.read_text(), "bash")]
SNIPPETS = [(page, code) for page in PAGES for code in documented.blocks(page.read_text(), "python")]


def test_readme_is_one_page() -> None:
    text = (REPOSITORY / "README.md").read_text()
    assert len(text.splitlines()) <= 150
    assert len([target for target in documented.links(text) if target.startswith("docs/pictures/")]) == 13


@pytest.mark.parametrize("page", [*PAGES, REPOSITORY / "CHANGELOG.md"], ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    text = page.read_text()
    for target in documented.links(text):
        name, _, anchor = target.partition("#")
        file = page if not name else page.parent / name
        assert file.resolve() in tracked(), f"{page.name} links to {target}"
        if anchor:
            assert anchor in documented.anchors(file.read_text()), f"{page.name} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_that_are_named_exist(page: Path) -> None:
    """Code in sentences that reads as a path of this repository is one."""
    roots = "gym_demohlm|lerobot_demohlm|lerobot_env_demohlm|tests|examples|results"
    named = re.findall(rf"`((?:{roots})/[\w./*-]*)`", page.read_text())
    missing = [name for name in named if tracked().isdisjoint(REPOSITORY.glob(name.rstrip("/")))]
    assert [name for name in missing if "pile_cubes" not in name] == []  # adding_a_task.md says where to put new files


def test_every_page_is_reached_from_the_readme() -> None:
    linked = {target.partition("#")[0] for target in documented.links((REPOSITORY / "README.md").read_text())}
    assert {f"docs/{page.name}" for page in PAGES[1:]} <= linked


def test_every_picture_is_shown() -> None:
    shown = {
        (page.parent / target.partition("#")[0]).resolve()
        for page in PAGES
        for target in documented.links(page.read_text())
    }
    pictures = [path for path in tracked() if path.suffix in (".png", ".webp", ".gif", ".svg", ".mp4", ".jpg")]
    assert [path.name for path in pictures if DOCS in path.parents and path.resolve() not in shown] == []


def test_the_repository_is_small() -> None:
    sizes = {path: path.stat().st_size for path in tracked() if path.is_file()}
    assert [path for path, size in sizes.items() if size > 10 * MIB] == []
    assert sum(sizes.values()) < 100 * MIB
    assert [path for path, size in sizes.items() if path.parent == DOCS / "pictures" and size > 3 * MIB] == []


@pytest.mark.parametrize(("page", "code"), SNIPPETS, ids=[page.name for page, _ in SNIPPETS])
def test_snippets_run(page: Path, code: str) -> None:
    names: dict[str, object] = {}
    exec(compile(code, page.name, "exec"), names)
    if "env" in names:
        names["env"].close()  # type: ignore[attr-defined]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_options_exist(page: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Each call of demohlm in a page names a verb and options of its help."""
    monkeypatch.setenv("COLUMNS", "200")
    helps: dict[str, str] = {}
    for words in documented.calls(page.read_text()):
        options = [part for word in words for part in re.findall(r"^--[a-z][a-z-]*", word)]
        end = next((place for place, word in enumerate(words) if not re.fullmatch(r"[a-z][a-z-]*", word)), len(words))
        verb = " ".join(words[:end])
        if verb not in helps:
            with pytest.raises(SystemExit) as done:
                raise SystemExit(cli.main([*words[:end], "--help"]))
            assert done.value.code in (0, None), f"{page.name}: demohlm {verb}"
            helps[verb] = capsys.readouterr().out
        for option in options:
            assert re.search(rf"{option}(?![a-z-])", helps[verb]), f"{page.name}: demohlm {verb} has no {option}"


def test_small_numbers() -> None:
    small = documented.small
    assert small(["demohlm", "generate", "--num-episodes", "1000", "--num-workers", "2"])[2:4] == [
        "--num-attempts",
        "3",
    ]
    assert small(["lerobot-eval", "--eval.n_episodes=50"]) == ["lerobot-eval", "--eval.n_episodes=2"]
    assert small(["uv", "run", "demohlm", "train"]) == ["demohlm", "train", "--steps", "4"]
    assert small(["pip", "install", "uv"]) == ["true"]
    ablation = ["demohlm", "verb", "--variants", "plain", "noise", "starts", "--seeds", "0"]
    assert small(ablation) == ["demohlm", "verb", "--variants", "plain", "noise", "--seeds", "0"]
    assert small(ablation[:4]) == ablation[:4]
    assert small(["lerobot-train", "--steps=9"]) == ["lerobot-train", "--steps=4"]


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("page", TO_RUN, ids=lambda page: page.name)
def test_commands_run(page: Path, tmp_path: Path) -> None:
    """The bash blocks of a page run one after the other in an empty directory, word for word but for their numbers."""
    code = NEEDED.get(page.name, "") + "\n".join(documented.blocks(page.read_text(), "bash"))
    work = tmp_path / "work"
    work.mkdir()
    (work / "examples").symlink_to(REPOSITORY / "examples")
    environment = documented.install_stand_ins(tmp_path / "bin")
    done = subprocess.run(["bash", "-e"], input=code, cwd=work, env=environment, capture_output=True, text=True)
    said = [line for line in done.stderr.splitlines() if re.match(r"\$ |error|\w*Error", line)]
    assert done.returncode == 0, "\n".join([*said, *done.stdout.splitlines()[-40:]])
