"""A dataset whose ``meta/info.json`` is cut off or says nonsense: one clear line, whatever command reads it."""

import shutil
from pathlib import Path

import pytest

from gym_demohlm.errors import DatasetError
from lerobot_demohlm import cli
from lerobot_demohlm.datasets.facts import INFO_PATH, read_info
from lerobot_demohlm.generation.block import write_block
from lerobot_demohlm.generation.run import GenerationRun
from lerobot_demohlm.policies.training import require_episodes
from tests.helpers.synthetic import make_episode, make_facts


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = GenerationRun.open(tmp_path_factory.mktemp("info") / "data", "local/name", make_facts(num_attempts=2))
    write_block(run.directory, run.facts, range(2), [make_episode(0), make_episode(1)])
    run.finish()
    return run.root


def test_a_whole_one_is_read(whole: Path) -> None:
    assert read_info(whole)["total_episodes"] == 2
    require_episodes(whole, 2)
    with pytest.raises(DatasetError, match="at most the 2"):
        require_episodes(whole, 3)


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"features": {}, "total_episodes": "2"}', None])
@pytest.mark.parametrize(
    "line",
    [
        "train --root data --output new --num-episodes 1",
        "train --root data --output new --write-config new.json",
        "push --root data --repo-id user/name",
        "card --root data --repo-id user/name --folder new",
    ],
)
def test_a_damaged_one_is_named(
    line: str,
    content: str | None,
    whole: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shutil.copytree(whole, tmp_path / "data")
    info = tmp_path / "data" / INFO_PATH
    info.write_text(info.read_text()[:100] if content is None else content)
    monkeypatch.chdir(tmp_path)
    assert cli.main(line.split()) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1
    assert err.startswith("error: got ") and f"data/{INFO_PATH}, damaged (" in err
    assert [path.name for path in tmp_path.iterdir()] == ["data"]
