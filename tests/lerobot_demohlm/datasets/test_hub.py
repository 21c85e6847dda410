"""``push`` against a local server that answers as the hub does: what arrives is what lies on disk, tagged."""

import base64
import hashlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from huggingface_hub import constants
from lerobot.datasets import LeRobotDatasetMetadata

from gym_demohlm.errors import DatasetError
from lerobot_demohlm import cli
from lerobot_demohlm.datasets.card import is_by_hand, render_card
from lerobot_demohlm.datasets.facts import read_facts
from lerobot_demohlm.datasets.hub import push
from lerobot_demohlm.generation.block import write_block
from lerobot_demohlm.generation.run import GenerationRun
from tests.helpers.synthetic import make_episode, make_facts

REPO = "user/name"


class FakeHub(ThreadingHTTPServer):
    """Keeps one dataset repository: files by branch and path, and tags by name.

    Parquet files arrive by LFS, others in the commit.
    """

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, bytes] = {}
        self.branches = {"main": self.files}
        self.objects: dict[str, bytes] = {}
        self.tags: dict[str, str] = {}
        self.deleted_tags: list[str] = []
        self.created: list[dict] = []
        self.tokens: set[str | None] = set()
        self.unexpected: list[str] = []
        self.refuse = False

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"


class Handler(BaseHTTPRequestHandler):
    server: FakeHub

    def log_message(self, format: str, *args: object) -> None:
        """Be quiet."""

    def answer(self, status: int, content: object = None, **headers: str) -> None:
        body = json.dumps(content if content is not None else {}).encode()
        self.send_response(status)
        for name, value in {"Content-Type": "application/json", "Content-Length": str(len(body)), **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)

    def body(self) -> bytes:
        return self.rfile.read(int(self.headers.get("Content-Length", 0)))

    def do_POST(self) -> None:
        hub, body, path = self.server, self.body(), self.path.split("?")[0]
        hub.tokens.add(self.headers.get("Authorization"))
        api = f"/api/datasets/{REPO}"
        if hub.refuse:
            self.answer(403, {"error": "not yours"})
        elif path == "/api/repos/create":
            hub.created.append(json.loads(body))
            self.answer(200, {"url": f"{hub.url}/datasets/{REPO}"})
        elif path == "/api/validate-yaml":
            self.answer(200, {"errors": [], "warnings": []})
        elif path.startswith(f"{api}/branch/"):
            hub.branches[path.rsplit("/", 1)[1]] = dict(hub.files)
            self.answer(200)
        elif path.startswith(f"{api}/preupload/"):
            names = [entry["path"] for entry in json.loads(body)["files"]]
            modes = [{"path": n, "uploadMode": "lfs" if n.endswith(".parquet") else "regular"} for n in names]
            self.answer(200, {"files": [mode | {"shouldIgnore": False} for mode in modes]})
        elif path == f"/datasets/{REPO}.git/info/lfs/objects/batch":
            objects = [
                entry | {"actions": {"upload": {"href": f"{hub.url}/lfs/{entry['oid']}"}}}
                for entry in json.loads(body)["objects"]
            ]
            self.answer(200, {"transfer": "basic", "objects": objects})
        elif path.startswith(f"{api}/commit/"):
            files = hub.branches[path.rsplit("/", 1)[1]]
            for line in body.splitlines():
                entry = json.loads(line)
                value = entry["value"]
                if entry["key"] == "file":
                    files[value["path"]] = base64.b64decode(value["content"])
                elif entry["key"] == "lfsFile":
                    files[value["path"]] = hub.objects[value["oid"]]
                elif entry["key"] == "deletedFile":
                    del files[value["path"]]
            commit = {"commitUrl": f"{hub.url}/datasets/{REPO}/commit/abc", "commitOid": "abc", "hookOutput": ""}
            self.answer(200, commit)
        elif path.startswith(f"{api}/tag/"):
            hub.tags[json.loads(body)["tag"]] = path.rsplit("/", 1)[1]
            self.answer(200)
        else:
            hub.unexpected.append(f"POST {self.path}")
            self.answer(404)

    def do_PUT(self) -> None:
        body = self.body()
        self.server.objects[hashlib.sha256(body).hexdigest()] = body
        self.answer(200)

    def do_GET(self) -> None:
        api, path = f"/api/datasets/{REPO}", self.path.split("?")[0]
        if path.startswith(f"{api}/tree/"):
            files = self.server.branches[path.removeprefix(f"{api}/tree/")].items()
            self.answer(200, [{"type": "file", "path": name, "size": len(data), "oid": "0"} for name, data in files])
        elif path.startswith(api):
            branch = path.partition("/revision/")[2] or "main"
            siblings = [{"rfilename": name} for name in self.server.branches[branch]]
            self.answer(200, {"id": REPO, "sha": "abc", "siblings": siblings})
        else:
            self.answer(404)  # the client asks for things that a hub may not have

    def do_DELETE(self) -> None:
        tag = self.path.rsplit("/", 1)[1]
        if self.server.tags.pop(tag, None) is None:
            self.answer(404, {"error": "no such tag"}, X_Error_Code="RevisionNotFound")
        else:
            self.server.deleted_tags.append(tag)
            self.answer(200)


@pytest.fixture
def hub() -> Iterator[FakeHub]:
    server = FakeHub()
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def root(tmp_path: Path) -> Path:
    run = GenerationRun.open(tmp_path / "data", "local/name", make_facts(num_attempts=2))
    write_block(run.directory, run.facts, range(2), [make_episode(0), make_episode(1)])
    run.finish()
    return run.root


def push_in_subprocess(hub: FakeHub, root: Path, home: Path, times: int) -> subprocess.CompletedProcess[str]:
    """Push as the command line does; the hub client reads its environment when it is imported.

    Xet, the hub's chunk storage, is switched off: the client then uploads large files by LFS, which is plain HTTP.
    """
    code = (
        "import sys; from pathlib import Path; from lerobot_demohlm.datasets.hub import push\n"
        "for _ in range(int(sys.argv[3])): print(push(Path(sys.argv[1]), sys.argv[2]))\n"
    )
    changes = {"HF_ENDPOINT": hub.url, "HF_TOKEN": "hf_secret", "HF_HOME": str(home)}
    changes |= {"HF_HUB_OFFLINE": "0", "HF_HUB_DISABLE_XET": "1"}
    arguments = [sys.executable, "-c", code, str(root), REPO, str(times)]
    return subprocess.run(arguments, env=os.environ | changes, capture_output=True, text=True)


@pytest.fixture
def reached(hub: FakeHub, monkeypatch: pytest.MonkeyPatch) -> FakeHub:
    """Return a hub that this process reaches, as far as the hub's client looks at its constants when it is called."""
    for name, value in {"ENDPOINT": hub.url, "HF_HUB_OFFLINE": False, "HF_HUB_DISABLE_XET": True}.items():
        monkeypatch.setattr(constants, name, value)
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    return hub


def content(root: Path) -> dict[str, bytes]:
    """Return the files of a dataset as a hub keeps them."""
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_push_twice(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    """Over a larger dataset of an earlier push, whose files go; others stay."""
    old = ("data/chunk-000/file-007.parquet", "meta/episodes/chunk-000/file-007.parquet", "videos/head/file-000.mp4")
    hub.files |= dict.fromkeys((*old, "notes.md", ".gitattributes"), b"old")
    done = push_in_subprocess(hub, root, tmp_path / "hf", times=2)  # the second moves the tag
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [f"{hub.url}/datasets/{REPO}"] * 2
    assert hub.unexpected == []
    assert hub.tags == {"v3.0": "main"}
    assert hub.deleted_tags == ["v3.0"]
    assert hub.files == content(root) | {"notes.md": b"old", ".gitattributes": b"old"}
    assert hub.created[0]["type"] == "dataset"
    assert hub.tokens == {"Bearer hf_secret"}
    assert f'LeRobotDataset("{REPO}")' in hub.files["README.md"].decode()  # the card names the repository pushed to


def test_a_new_repository_is_public_or_private_as_asked(reached: FakeHub, root: Path) -> None:
    for options in ([], ["--private"]):
        assert cli.main(["push", "--root", str(root), "--repo-id", REPO, *options]) == 0
    assert "visibility" not in reached.created[0], "the account's default"
    assert reached.created[1]["visibility"] == "private"
    assert reached.tags == {"v3.0": "main"} and list(reached.branches) == ["main"] and reached.unexpected == []


def test_a_branch_is_pushed_to_and_tagged_alone(reached: FakeHub, root: Path) -> None:
    """Also what an earlier push left there goes there alone."""
    old = {"data/chunk-000/file-007.parquet": b"old", "notes.md": b"old"}
    reached.files |= old
    assert cli.main(["push", "--root", str(root), "--repo-id", REPO, "--branch", "trial"]) == 0
    assert reached.branches == {"main": old, "trial": content(root) | {"notes.md": b"old"}}
    assert reached.tags == {"v3.0": "trial"} and reached.unexpected == []


def test_a_card_that_was_edited_is_pushed_as_it_is(
    reached: FakeHub, root: Path, caplog: pytest.LogCaptureFixture
) -> None:
    card = root / "README.md"
    edited = card.read_bytes() + b"\nWrite to us.\n"
    card.write_bytes(edited)
    push(root, REPO)
    assert reached.files["README.md"] == card.read_bytes() == edited
    assert "pushed as it is, since it was edited" in caplog.text
    card.unlink()
    push(root, REPO)
    assert reached.files["README.md"] == card.read_bytes() != edited, "a new one"


def test_a_card_that_was_edited_is_known(root: Path) -> None:
    card, meta, facts = root / "README.md", LeRobotDatasetMetadata("local/name", root=root), read_facts(root)
    assert not is_by_hand(card, meta, facts)
    card.write_text(render_card(meta, "another/name", facts))
    assert not is_by_hand(card, meta, facts), "of an earlier push"
    card.write_text(card.read_text() + "\nWrite to us.\n")
    assert is_by_hand(card, meta, facts)
    card.unlink()
    assert not is_by_hand(card, meta, facts)


def test_refusal_is_one_clear_error(reached: FakeHub, root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reached.refuse = True
    assert cli.main(["push", "--root", str(root), "--repo-id", REPO]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("error: got HfHubHTTPError")
    assert "403" in said


def test_bad_arguments_are_refused_before_any_request(root: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="demohlm generate"):
        push(tmp_path, REPO)
    with pytest.raises(DatasetError, match="user/name"):
        push(root, "name")
