"""The page's server with a headset and a spectator -> latency, pace, and how far a hand jumps when it is engaged again.

With ``browser`` the headset is Chromium's, emulated (npm ``iwer``), and drawn in software: install PyPI's
``playwright`` and Debian's ``chromium``. The browsers stand for other machines, so they get a lower priority than the
server. Without it, two programs talk to the server as such pages do, and draw nothing.
"""

import asyncio
import itertools
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import aiohttp
import numpy as np

from gym_demohlm.errors import DemoHLMError
from gym_demohlm.task import Task

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = [
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking",
    "--no-first-run", "--disable-component-update", "--disable-sync",
]  # fmt: skip
HEADSET = """
const device = new IWER.XRDevice(IWER.metaQuest3);
device.installRuntime({forceInstall: true});
device.position.set(0, 1.6, 0);
for (const [side, x] of [["left", -0.2], ["right", 0.2]]) device.controllers[side].position.set(x, 1.2, -0.3);
window.headset = device;
"""
HEADSET_HZ = 72
WAY_M, WAY_HZ = 0.05, 0.3  # how the hands move
HOLD_S, FREE_S = 4.0, 1.0  # the clutch is held, then let go, while the hands go on elsewhere
_MOVE = f"""
setInterval(() => {{
  const t = performance.now() / 1000, held = t % {HOLD_S + FREE_S} < {HOLD_S};
  for (const [side, x] of [["left", -0.2], ["right", 0.2]]) {{
    const c = headset.controllers[side], s = Math.sin({2 * math.pi * WAY_HZ} * t);
    c.position.set(x, 1.2 + {WAY_M} * s + (held ? 0 : 0.1), -0.3 + {WAY_M} * s);
    c.updateButtonValue("squeeze", held ? 1 : 0);
  }}
}}, {1000 / HEADSET_HZ});
"""
NICE = 10
MIN_S, MAX_S = 2.5 * (HOLD_S + FREE_S), 110.0  # a recording ends after 2 minutes
SOCKET = {"max_msg_size": 2**24, "heartbeat": 5.0}


class TeleoperationError(DemoHLMError):
    """A measurement that cannot be made here."""


def measure(task: Task, seconds: float, browser: bool, iwer: Path | None = None) -> dict[str, Any]:
    """Serve a task for a while to a headset that moves both hands, and to a spectator.

    Args:
        task: The task.
        seconds: How long [s].
        browser: Whether both are Chromium.
        iwer: Path of ``iwer.min.js``; needed with a browser.

    With a browser, this process has a lower priority from then on.

    Returns:
        Latency from page to applied command [ms], real-time factor, largest jump [mm], and frames a second.

    Raises:
        TeleoperationError: There is no browser or no headset to emulate, or nothing was measured.
    """
    if browser and (iwer is None or not iwer.exists()):
        raise TeleoperationError(f"no headset to emulate at {iwer}", "iwer.min.js", "npm pack iwer@2.5.0, then --iwer")
    if not MIN_S <= seconds <= MAX_S:
        raise TeleoperationError(f"{seconds} s", f"{MIN_S:g} to {MAX_S:g} s", "correct --seconds")
    with tempfile.TemporaryDirectory() as scratch, _server(task, Path(scratch) / "recorded") as addresses:
        if browser:
            assert iwer is not None  # checked above
            os.nice(NICE)
            seen, frames = asyncio.run(_with_browsers(addresses, seconds, iwer))
        else:
            seen, frames = asyncio.run(_with_programs(addresses, seconds)), {}
    last, jumps = seen[-1], _jumps(seen)
    if "p99_ms" not in last["latency"] or not jumps:
        raise TeleoperationError(f"{last['latency']} and {len(jumps)} jumps", "both measured", "measure for longer")
    ticks = last["tick"] - seen[0]["tick"]
    return {
        "task": task.name,
        "clients": "chromium, software rendering" if browser else "programs that draw nothing",
        "seconds": seconds,
        "messages": last["latency"]["count"],
        "p50_ms": last["latency"]["p50_ms"],
        "p99_ms": last["latency"]["p99_ms"],
        "real_time_factor": round(0.1 * ticks / (last["heard_s"] - seen[0]["heard_s"]), 4),
        "engaged_again": len(jumps),
        "jump_mm": round(1e3 * max(jumps, default=0.0), 4),
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[0], 2),
        **frames,
    }


@contextmanager
def _server(task: Task, root: Path) -> Iterator[dict[str, str]]:
    """Serve a task from a process of its own, and yield its addresses."""
    command = [sys.executable, "-m", "lerobot_demohlm.cli", "record", "--task", task.name, "--teleop", "web"]
    command += ["--port", "0", "--trial", "0", "--root", str(root)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        if not line:
            raise TeleoperationError(f"no server (exit code {process.wait()})", "one", f"try {' '.join(command)}")
        yield json.loads(line)
    finally:
        process.kill()
        process.wait()


def find_browser() -> str | None:
    """Return the path of a browser; None where there is none."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


async def _with_browsers(
    addresses: dict[str, str], seconds: float, iwer: Path
) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """Open the page with a headset and as a spectator; returns what the server said, and frames drawn a second."""
    from playwright.async_api import async_playwright

    path = find_browser()
    if path is None:
        raise TeleoperationError("no browser", f"one of {', '.join(BROWSERS)}", "apt-get install chromium")
    async with async_playwright() as playwright:
        launched = await playwright.chromium.launch(executable_path=path, args=FLAGS)
        pages = []
        for role in ("operator", "spectator"):
            context = await launched.new_context(viewport={"width": 480, "height": 320}, bypass_csp=True)
            page = await context.new_page()
            if role == "operator":
                await page.add_init_script(path=iwer)
                await page.add_init_script(HEADSET)
            await page.goto(addresses[role])
            await page.wait_for_function("window.demohlm && demohlm.frames > 3 && demohlm.status", timeout=120_000)
            pages.append(page)
        operator = pages[0]
        await operator.evaluate("document.getElementById('head-moves').checked = false")
        await operator.evaluate("document.getElementById('enter-vr').click()")
        await operator.wait_for_function("demohlm.controls.xr && demohlm.controls.xr.hands.right.pose", timeout=120_000)
        await operator.evaluate(_MOVE)
        await operator.evaluate("document.getElementById('record').click()")

        async def drawn() -> list[float]:
            return [await page.evaluate("demohlm.drawn + demohlm.xrFrames") for page in pages]

        first = await drawn()
        async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as http:
            seen = await _watch(http, addresses["spectator"], seconds)
        counts = [(after - before) / seconds for after, before in zip(await drawn(), first, strict=True)]
        await launched.close()
    names = ("headset_frames_per_s", "spectator_frames_per_s")
    return seen, {name: round(count, 1) for name, count in zip(names, counts, strict=True)}


async def _with_programs(addresses: dict[str, str], seconds: float) -> list[dict[str, Any]]:
    """Send what a headset's page sends, and watch."""
    jar = aiohttp.CookieJar(unsafe=True)
    async with (
        aiohttp.ClientSession(cookie_jar=jar) as http,
        aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as other,
    ):
        async with http.get(addresses["operator"]):
            pass
        async with http.ws_connect(_origin(addresses["operator"]) + "/ws", **SOCKET) as socket:
            await socket.send_json({"type": "press", "button": "record"})
            sending, hearing = asyncio.create_task(_send(socket)), asyncio.create_task(_hear(socket))
            seen = await _watch(other, addresses["spectator"], seconds)
            sending.cancel()
            hearing.cancel()
    return seen


async def _send(socket: aiohttp.ClientWebSocketResponse) -> None:
    """Send the hands of a headset at its rate."""
    began, number = time.monotonic(), 0
    while True:
        t = time.monotonic() - began
        held, sway = t % (HOLD_S + FREE_S) < HOLD_S, WAY_M * math.sin(2.0 * math.pi * WAY_HZ * t)
        hands = {
            side: {"pose": [x, 1.2 + sway + (0.0 if held else 0.1), -0.3 + sway, 1, 0, 0, 0], "engaged": held}
            for side, x in (("left", -0.2), ("right", 0.2))
        }
        message = {"type": "input", "seq": number, "t": time.time(), "device": "headset", "hands": hands}
        await socket.send_json(message | {"head": [0, 1.6, 0, 1, 0, 0, 0], "lean": False})
        number += 1
        await asyncio.sleep(max(0.0, began + number / HEADSET_HZ - time.monotonic()))


async def _hear(socket: aiohttp.ClientWebSocketResponse) -> None:
    """Read what comes, as a page does."""
    async for _ in socket:
        pass


async def _watch(http: aiohttp.ClientSession, address: str, seconds: float) -> list[dict[str, Any]]:
    """Return the statuses that a spectator hears, each with when it was heard."""
    async with http.get(address):
        pass
    seen: list[dict[str, Any]] = []
    async with http.ws_connect(_origin(address) + "/ws", **SOCKET) as socket:
        async for message in socket:
            if message.type != aiohttp.WSMsgType.TEXT:
                continue
            content = json.loads(message.data)
            if content["type"] == "status" and content["state"] == "recording":
                seen.append(content | {"heard_s": time.monotonic()})
                if seen[-1]["heard_s"] - seen[0]["heard_s"] >= seconds:
                    return seen
    raise TeleoperationError("a server that has gone", "one that stays", "measure again")


def _origin(address: str) -> str:
    parts = urlsplit(address)
    return f"{parts.scheme}://{parts.netloc}"


def _jumps(seen: list[dict[str, Any]]) -> list[float]:
    """Return how far each palm's target went in the step in which its hand was engaged again [m]."""
    found = []
    for before, after in itertools.pairwise(seen):
        for index, side in enumerate(("left", "right")):
            if after["engaged"][index] and not before["engaged"][index] and after["tick"] == before["tick"] + 1:
                way = np.subtract(after["poses"][f"{side}_target"][:3], before["poses"][f"{side}_target"][:3])
                found.append(float(np.linalg.norm(way)))
    return found
