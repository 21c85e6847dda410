"""Whatever is in a file, a loader returns what it should or says what is wrong; it runs nothing, and goes nowhere."""

import dataclasses
import io
import json
import pickle
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gym_demohlm.control.whole_body import DEFAULT_WEIGHTS, Weights
from gym_demohlm.errors import DatasetError, DemoHLMError, DemonstrationError, SceneError
from gym_demohlm.registry import get_task
from lerobot_demohlm.datasets import episode, facts, writer
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.segmentation import segment
from lerobot_demohlm.generation.block import block_directory, pack_block, read_block, unpack_block, write_block
from lerobot_demohlm.generation.run import GenerationRun, partial_directory
from tests.helpers.synthetic import make_episode, make_facts

TASK = get_task("LiftBox")
FUZZ = settings(
    max_examples=30, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


@st.composite
def damaged(draw: st.DrawFn, content: bytes) -> bytes:
    """Return a file with bytes changed, cut off, put in or thrown away, or another one altogether."""
    if draw(st.integers(0, 5)) == 0:
        return draw(st.binary(max_size=64))
    spoiled = bytearray(content)
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, len(spoiled)))
        stop = start + draw(st.sampled_from((0, 1, 1, 1, 8, len(spoiled))))
        spoiled[start:stop] = draw(st.binary(max_size=8))
    return bytes(spoiled)


@st.composite
def changed(draw: st.DrawFn, content: dict[str, Any]) -> Any:
    """Return a JSON object with an entry changed or gone, or something else altogether."""
    if draw(st.integers(0, 5)) == 0:
        return draw(VALUES)
    key = draw(st.sampled_from(sorted(content)))
    if draw(st.booleans()):
        return {name: value for name, value in content.items() if name != key}
    return content | {key: draw(VALUES)}


def write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content))


@pytest.fixture(scope="module")
def demonstration() -> Demonstration:
    return demonstrations.load(task=TASK)


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("copy") / "demonstration"
    return Path(shutil.copytree(demonstrations.default_root(TASK), root))


def loads_as_before_or_says_why(load: Callable[[], str], expected: str) -> None:
    try:
        assert load() == expected
    except DemoHLMError as error:
        assert error.got and error.expected and error.remedy


@pytest.mark.parametrize("name", ["data", "snapshots", "meta"])
@FUZZ
@given(data=st.data())
def test_demonstrations_with_damaged_files(name: str, copy: Path, demonstration: Demonstration, data: Any) -> None:
    path = {
        "data": next((copy / "data").rglob("*.parquet")),
        "snapshots": copy / demonstrations.SNAPSHOTS_PATH,
        "meta": copy / demonstrations.META_PATH,
    }[name]
    whole = path.read_bytes()
    try:
        path.write_bytes(data.draw(damaged(whole)))
        loads_as_before_or_says_why(lambda: demonstrations.load(copy, TASK).content_hash, demonstration.content_hash)
    finally:
        path.write_bytes(whole)


@FUZZ
@given(data=st.data())
def test_demonstrations_with_other_metadata(copy: Path, demonstration: Demonstration, data: Any) -> None:
    path = copy / demonstrations.META_PATH
    whole = path.read_text()
    try:
        write_json(path, data.draw(changed(json.loads(whole))))
        loads_as_before_or_says_why(lambda: demonstrations.load(copy).content_hash, demonstration.content_hash)
    finally:
        path.write_text(whole)


def test_a_demonstration_names_no_module_to_be_imported(
    copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "strange.py").write_text("raise AssertionError('a file had this module imported')")
    monkeypatch.syspath_prepend(tmp_path)
    path = copy / demonstrations.META_PATH
    whole = path.read_text()
    try:
        write_json(path, json.loads(whole) | {"task": "strange:LiftBox"})
        with pytest.raises(DemonstrationError, match="strange:LiftBox"):
            demonstrations.load(copy)
    finally:
        path.write_text(whole)


SEGMENTS = st.fixed_dictionaries(
    {},
    optional={
        "hand": st.sampled_from(("left", "right")) | VALUES,
        "kind": st.sampled_from(("object", "proprioception")) | VALUES,
        "start": st.sampled_from((0, 10)) | VALUES,
        "stop": st.sampled_from((10, 100)) | VALUES,
        "object": st.sampled_from(("box",)) | VALUES,
        "anchor": st.sampled_from(("eef", "root")) | VALUES,
    },
)


@FUZZ
@given(corrections=VALUES | st.fixed_dictionaries({"segments": st.lists(SEGMENTS, max_size=4) | VALUES}))
def test_corrections_of_any_kind(copy: Path, demonstration: Demonstration, corrections: Any) -> None:
    """They cover every tick once, or they are refused."""
    path = copy / demonstrations.CORRECTIONS_PATH
    try:
        write_json(path, corrections)
        segments = segment(demonstrations.load(copy, TASK), TASK)
        assert sum(entry.stop - entry.start for entry in segments) == 2 * len(demonstration)
    except DemonstrationError as error:
        assert "segments.json" in error.remedy
    finally:
        path.unlink()


@pytest.mark.parametrize(
    "changes",
    [{"start": 10.0}, {"start": "10"}, {"object": ["box"]}, {"anchor": {}}, {"kind": []}, {"hand": ["left"]}],
)
def test_corrections_of_the_wrong_type(demonstration: Demonstration, changes: dict[str, Any]) -> None:
    entries = [dataclasses.asdict(entry) for entry in segment(demonstration, TASK)]
    entries.append(entries[1] | changes)
    wrong = dataclasses.replace(demonstration, corrections={"segments": entries})
    with pytest.raises(DemonstrationError, match=r"segments\.json"):
        segment(wrong, TASK)


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the directory of a run with one block."""
    directory = tmp_path_factory.mktemp("run")
    (directory / "blocks").mkdir()
    episodes = [make_episode(0, length=3), make_episode(1, outcome="fell", length=0)]
    write_block(directory, make_facts(), range(2), episodes)
    return directory


@FUZZ
@given(data=st.data())
def test_blocks_with_damaged_files(block: Path, data: Any) -> None:
    """A block is what was written, bit for bit, or it is refused."""
    whole = pack_block(block, range(2))
    name = data.draw(st.sampled_from(sorted(whole)))
    path = block_directory(block, range(2)) / name
    try:
        path.write_bytes(data.draw(damaged(whole[name])))
        records = read_block(block, make_facts(), range(2))
        assert path.read_bytes() == whole[name] or name == "block.json"
        assert [record["outcome"] for record in records] == ["success", "fell"]
    except DatasetError as error:
        assert "damaged" in error.got
    finally:
        path.write_bytes(whole[name])


@FUZZ
@given(manifest=VALUES | st.fixed_dictionaries({"attempts": VALUES, "facts": VALUES, "files": VALUES}))
def test_blocks_with_another_manifest(block: Path, manifest: Any) -> None:
    path = block_directory(block, range(2)) / "block.json"
    whole = path.read_bytes()
    try:
        write_json(path, manifest)
        with pytest.raises(DatasetError, match="damaged"):
            read_block(block, make_facts(), range(2))
    finally:
        path.write_bytes(whole)


def test_blocks_of_another_run_are_refused(block: Path) -> None:
    with pytest.raises(DatasetError, match="another run"):
        read_block(block, make_facts(seed=1), range(2))


@FUZZ
@given(data=st.data())
def test_runs_with_other_facts(tmp_path: Path, data: Any) -> None:
    root = tmp_path / "data"
    GenerationRun.open(root, "user/name", make_facts()).close()
    path = partial_directory(root) / "run.json"
    whole = path.read_bytes()
    before = json.loads(whole)
    after = data.draw(changed(before))
    try:
        write_json(path, after)
        GenerationRun.open(root, "user/name", make_facts()).close()
        assert facts.GenerationFacts.read(after) == make_facts()  # a knob that is left out is a plain one
    except DatasetError as error:
        assert "--root" in error.remedy
    finally:
        path.write_bytes(whole)


@FUZZ
@given(data=st.data())
def test_runs_with_damaged_facts(tmp_path: Path, data: Any) -> None:
    root = tmp_path / "data"
    GenerationRun.open(root, "user/name", make_facts()).close()
    path = partial_directory(root) / "run.json"
    whole = path.read_bytes()
    try:
        path.write_bytes(data.draw(damaged(whole)))
        GenerationRun.open(root, "user/name", make_facts()).close()
        assert json.loads(path.read_bytes()) == json.loads(whole)
    except DatasetError as error:
        assert "--root" in error.remedy
    finally:
        path.write_bytes(whole)


RECORD = make_episode(0).record()


@FUZZ
@given(data=st.data())
def test_records_of_attempts(tmp_path: Path, data: Any) -> None:
    path = tmp_path / facts.ATTEMPTS_PATH
    path.parent.mkdir(exist_ok=True)
    if data.draw(st.booleans()):
        write_json(path, data.draw(changed(RECORD)))
    else:
        path.write_bytes(data.draw(damaged(json.dumps(RECORD).encode())))
    try:
        records = facts.read_attempts(tmp_path)
        assert all(record["outcome"] in episode.OUTCOMES and record["frames"] >= 0 for record in records)
    except DatasetError as error:
        assert "attempt" in error.expected or "JSON" in error.expected


@FUZZ
@given(data=st.data())
def test_facts_of_datasets(tmp_path: Path, data: Any) -> None:
    path = tmp_path / facts.FACTS_PATH
    path.parent.mkdir(exist_ok=True)
    kept = facts.write_facts(tmp_path, make_facts(), [RECORD])
    if data.draw(st.booleans()):
        write_json(path, data.draw(changed(kept)))
    else:
        path.write_bytes(data.draw(damaged(json.dumps(kept).encode())))
    try:
        content = facts.read_facts(tmp_path)
        assert isinstance(content["task"], str) and isinstance(content["outcomes"], dict)
    except DatasetError as error:
        assert "demohlm.json" in error.got


@pytest.mark.parametrize("name", ["../outside", "/tmp/outside", "episodes/../../outside", ".."])
def test_blocks_from_elsewhere_stay_in_their_directory(tmp_path: Path, name: str) -> None:
    (tmp_path / "run" / "blocks").mkdir(parents=True)
    with pytest.raises(DatasetError, match="a name inside"):
        unpack_block(tmp_path / "run", range(2), {"attempts.jsonl": b"", name: b""})
    assert [path.name for path in tmp_path.rglob("*")] == ["run", "blocks"]


@pytest.mark.parametrize("path", ["../other/data/file-{file_index}.parquet", "/tmp/data-{file_index}.parquet"])
def test_datasets_do_not_lead_outside(tmp_path: Path, path: str) -> None:
    writer.write_dataset(tmp_path / "data", "user/name", [make_episode(0)])
    info = tmp_path / "data" / "meta" / "info.json"
    write_json(info, json.loads(info.read_text()) | {"data_path": path})
    with pytest.raises(DatasetError, match="inside of the dataset"):
        list(writer.read_arrays(tmp_path / "data"))


class Bomb:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self.path,)


def test_nothing_is_unpickled(tmp_path: Path, copy: Path) -> None:
    went_off = tmp_path / "went off"
    pickle.loads(pickle.dumps(Bomb(went_off)))
    assert went_off.exists()
    went_off.unlink()
    snapshots, weights = copy / demonstrations.SNAPSHOTS_PATH, tmp_path / "weights.npz"
    whole = snapshots.read_bytes()
    for path, original in ((snapshots, snapshots), (weights, DEFAULT_WEIGHTS)):
        with np.load(original) as arrays:
            content = dict(arrays)
        content[sorted(content)[0]] = np.array([Bomb(went_off)], dtype=object)
        with path.open("wb") as file:
            np.savez(file, **content)
    try:
        with pytest.raises(DemonstrationError, match="damaged"):
            demonstrations.load(copy, TASK)
    finally:
        snapshots.write_bytes(whole)
    with pytest.raises(SceneError, match="cannot be read"):
        Weights(weights)
    assert not went_off.exists()


@FUZZ
@given(data=st.data())
def test_damaged_weights(tmp_path: Path, data: Any) -> None:
    path = tmp_path / "weights.npz"
    path.write_bytes(data.draw(damaged(DEFAULT_WEIGHTS.read_bytes())))
    try:
        assert np.isfinite(Weights(path).mean).all()
    except SceneError as error:
        assert "weights" in error.got


def test_weights_of_a_zip_version_to_come_are_refused(tmp_path: Path) -> None:
    content, path = bytearray(DEFAULT_WEIGHTS.read_bytes()), tmp_path / "weights.npz"
    content[content.index(b"PK\x01\x02") + 6] = 176  # of the central directory's first entry: version 17.6 is needed
    path.write_bytes(content)
    with pytest.raises(SceneError, match=r"cannot be read \(zip file version 17\.6"):
        Weights(path)


def test_a_zip_that_promises_too_much_is_refused(tmp_path: Path, copy: Path) -> None:
    """A header that asks for 8 TB of zeros is an error, not an allocation that is tried for ever."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    snapshots = copy / demonstrations.SNAPSHOTS_PATH
    whole = snapshots.read_bytes()
    try:
        with zipfile.ZipFile(snapshots, "w") as archive:
            archive.writestr("start.physics.npy", header.getvalue())
        with pytest.raises(DemonstrationError, match="damaged"):
            demonstrations.load(copy, TASK)
    finally:
        snapshots.write_bytes(whole)
