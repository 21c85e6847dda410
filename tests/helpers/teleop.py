"""A page served in this process, a browser with an emulated headset, and a hand that follows a script through them."""

import asyncio
import json
import os
import shutil
import subprocess
import tarfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.registry import get_task
from lerobot_demohlm.benchmarks import teleoperation
from lerobot_demohlm.teleop.operator import OperatorPoses, SceneView
from lerobot_demohlm.teleop.session import RecordingSession, SessionSettings
from lerobot_demohlm.teleop.web.protocol import room_pose
from lerobot_demohlm.teleop.web.record import operators_place
from lerobot_demohlm.teleop.web.server import TeleopServer

IWER = "iwer@2.5.0"
SIDES = ("left", "right")


class Served:
    """A session of a task, served by threads of this process.

    Args:
        task: Name of the task.
        root: Where its demonstration goes.
        settings: Of the session; no trial by default.
        prepare: Does something with the session before it is served.
    """

    def __init__(
        self,
        task: str,
        root: Path,
        settings: SessionSettings | None = None,
        prepare: Callable[[RecordingSession], object] = lambda _session: None,
    ) -> None:
        self.task = get_task(task)
        settings = settings or SessionSettings(trial=None)
        self.session = RecordingSession(self.task, root, operators_place(self.task), settings=settings)
        prepare(self.session)
        announced: list[str] = []
        self.server = TeleopServer(self.session, port=0, announce=announced.append)
        self._loop = asyncio.new_event_loop()
        self._serving: asyncio.Task[None] | None = None
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        wait_for(lambda: announced or self.error, 60.0)
        self.addresses: dict[str, str] = json.loads(announced[0])

    def _run(self) -> None:
        try:
            self._serving = self._loop.create_task(self.server.serve())
            self._loop.run_until_complete(self._serving)
        except asyncio.CancelledError:
            pass
        except BaseException as error:
            self.error = error

    def invite(self) -> str:
        """Return one more operator's address."""
        self.server._tokens["invited" + os.urandom(8).hex()] = "operator"
        return self.server._addresses("invite")["operator"]

    def close(self) -> None:
        """Stop serving."""
        if self._thread.is_alive() and self._serving is not None:
            self._loop.call_soon_threadsafe(self._serving.cancel)
        self._thread.join(20.0)
        self.session.close()


@contextmanager
def serving(task: str, root: Path) -> Iterator[Served]:
    """Serve a session of a task without a trial; the server must not have failed by the end."""
    made = Served(task, root)
    try:
        yield made
    finally:
        made.close()
    assert made.error is None


def wait_for(condition: Callable[[], object], timeout_s: float = 120.0) -> None:
    """Wait until something holds.

    Raises:
        TimeoutError: It did not.
    """
    end = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"waited {timeout_s} s")
        time.sleep(0.01)


def find_browser() -> str:
    """Return the path of a browser; skips the test where there is none."""
    pytest.importorskip("playwright.sync_api", reason="the page is not tested: install playwright (uv sync)")
    path = teleoperation.find_browser()
    if path is not None:
        return path
    pytest.skip("the page is not tested: no browser here (Debian: apt-get install chromium)")


def fetch_iwer(directory: Path) -> Path:
    """Return the script of the emulated headset, from npm's registry; skips the test where it cannot be had."""
    given = os.environ.get("DEMOHLM_IWER")
    if given is not None:
        return Path(given)
    if shutil.which("npm") is None:
        pytest.skip(f"the headset is not tested: neither npm nor DEMOHLM_IWER, the path of {IWER}'s iwer.min.js")
    packed = subprocess.run(["npm", "pack", IWER], cwd=directory, capture_output=True, text=True, check=False)
    if packed.returncode != 0:
        pytest.skip(f"the headset is not tested: npm pack {IWER} failed ({packed.stderr.strip()[-200:]})")
    with tarfile.open(directory / packed.stdout.split()[-1]) as archive:
        archive.extractall(directory, filter="data")
    return directory / "package" / "build" / "iwer.min.js"


@contextmanager
def opened(browser: Any, address: str, *scripts: str | Path, small: bool = False) -> Iterator[Any]:
    """Open a page that shows the scene, with these scripts run before its own; a small one is drawn sooner."""
    size = {"width": 480, "height": 320} if small else {"width": 1280, "height": 800}
    context = browser.new_context(viewport=size, bypass_csp=True)  # to evaluate strings
    page = context.new_page()
    page.set_default_timeout(120_000)  # a busy machine draws slowly
    page.problems = []
    page.on("pageerror", lambda error: page.problems.append(str(error)))
    for script in scripts:
        page.add_init_script(path=script) if isinstance(script, Path) else page.add_init_script(script)
    page.goto(address)
    page.wait_for_function("window.demohlm && demohlm.frames > 3 && demohlm.status", timeout=60_000)
    try:
        yield page
        assert page.problems == []
    finally:
        context.close()


def view_of(status: dict[str, Any]) -> SceneView:
    """Return what a scripted operator sees, from what the page was told."""
    T = {name: poses.pose(np.array(p[:3]), np.array(p[3:])) for name, p in status["poses"].items()}
    own = {"pelvis", "head", "left_palm", "right_palm", "left_target", "right_target"}
    return SceneView(
        tick=status["tick"],
        T_world_head=T["head"],
        T_world_pelvis=T["pelvis"],
        T_world_hands=np.stack([T["left_palm"], T["right_palm"]]),
        T_world_objects={name: pose for name, pose in T.items() if name not in own},
    )


class HeadsetHands:
    """Moves the controllers of an emulated headset so that the palms' targets go where a script wants them.

    It knows no more of the server's clutch than a person does: a motion of the hand is a motion of the palm.
    """

    def __init__(self, page: Any) -> None:
        self._page = page
        page.evaluate("document.getElementById('head-moves').checked = false")
        page.evaluate("document.getElementById('enter-vr').click()")
        page.wait_for_function("demohlm.controls.xr && demohlm.controls.xr.hands.right.pose", timeout=60_000)
        self._T_room_controller = [
            poses.pose([*p[:3]], [*p[3:]])
            for p in page.evaluate(
                """["left", "right"].map(s => { const c = headset.controllers[s], p = c.position, q = c.quaternion;
                return [p.x, p.y, p.z, q.w, q.x, q.y, q.z]; })"""
            )
        ]
        grips = page.evaluate("['left', 'right'].map(s => demohlm.controls.xr.hands[s].pose)")
        self._T_controller_grip = [
            poses.invert(T) @ poses.pose(p[:3], p[3:]) for T, p in zip(self._T_room_controller, grips, strict=True)
        ]
        self._T_room_grip = [poses.pose(p[:3], p[3:]) for p in grips]
        self._engaged_targets: np.ndarray | None = None
        self._turn = np.eye(3)

    def squeeze(self, held: bool = True) -> None:
        """Engage both hands, or let go."""
        for side in SIDES:
            self.set(side, squeeze=float(held))
        self._page.wait_for_function(f"demohlm.status.engaged.every(e => e === {str(held).lower()})", timeout=30_000)
        status = self._page.evaluate("demohlm.status")
        if held:
            self._engaged_targets = np.stack(
                [poses.pose(np.array(p[:3]), np.array(p[3:])) for p in (status["poses"][f"{s}_target"] for s in SIDES)]
            )
            self._turn = poses.planar(0.0, 0.0, self._page.evaluate("demohlm.scene.home[2]"))[:3, :3]

    def set(self, side: str, **buttons: float) -> None:
        """Press trigger or squeeze of a controller."""
        for name, value in buttons.items():
            self._page.evaluate(f"headset.controllers.{side}.updateButtonValue('{name}', {value})")

    def stick(self, side: str, x: float, y: float) -> None:
        """Push a thumbstick; y is -1 ahead."""
        self._page.evaluate(f"headset.controllers.{side}.updateAxes('thumbstick', {x}, {y})")

    def behind(self, status: dict[str, Any], asked: OperatorPoses) -> float:
        """Return how far the palms' targets are from what was asked of the controllers [m]."""
        targets = np.array([status["poses"][f"{side}_target"][:3] for side in SIDES])
        return float(np.abs(targets - asked.T_world_hands[:, :3, 3]).max())

    def move(self, asked: OperatorPoses) -> None:
        """Bring the controllers to where the palms are asked to be, and the triggers with them."""
        assert self._engaged_targets is not None
        moves = []
        for index in range(len(SIDES)):
            start, wanted = self._engaged_targets[index], asked.T_world_hands[index]
            offset = self._turn.T @ (wanted[:3, 3] - start[:3, 3])
            turned = self._turn.T @ wanted[:3, :3] @ start[:3, :3].T @ self._turn
            moved = room_pose(poses.from_rotation(turned, offset))  # a motion, in the room's axes
            motion = poses.pose(moved[:3], moved[3:])
            grip = self._T_room_grip[index].copy()
            grip[:3, :3] = motion[:3, :3] @ grip[:3, :3]
            grip[:3, 3] += motion[:3, 3]
            position, q = poses.split(grip @ poses.invert(self._T_controller_grip[index]))
            moves.append([*position.tolist(), *q.tolist(), float(asked.grippers[index])])
        self._page.evaluate(
            """moves => ["left", "right"].forEach((s, i) => { const c = headset.controllers[s], m = moves[i];
            c.position.set(m[0], m[1], m[2]); c.quaternion.set(m[4], m[5], m[6], m[3]);
            c.updateButtonValue('trigger', m[7]); })""",
            moves,
        )


def statuses(page: Any, timeout_s: float = 300.0) -> Iterator[dict[str, Any]]:
    """Yield the status of every new step that the page is told of; some may be missed."""
    last, end = -1, time.monotonic() + timeout_s
    while time.monotonic() < end:
        status = page.evaluate("demohlm.status")
        if status["tick"] != last or status["state"] != "recording":
            last = status["tick"]
            yield status
        else:
            time.sleep(0.01)
    raise TimeoutError(f"waited {timeout_s} s")
