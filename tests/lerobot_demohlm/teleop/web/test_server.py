"""The server without a browser: who may do what, and what happens when nobody is there any more."""

import asyncio
import errno
import json
import logging
import signal
import subprocess
import sys
from collections.abc import Awaitable, Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest

from lerobot_demohlm.teleop.clutch import RETURN_M
from lerobot_demohlm.teleop.web import protocol
from lerobot_demohlm.teleop.web.certificate import make_context
from lerobot_demohlm.teleop.web.server import MAX_REFUSED, _equal
from tests.helpers.slow_network import slow_network
from tests.helpers.teleop import Served, serving

WALK = {"type": "input", "walk": [1, 0, 0], "device": "other"}


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serving("LiftBox", tmp_path_factory.mktemp("served") / "lift") as made:
        yield made


class Client:
    """A connection, as another program would make it."""

    def __init__(self, http: aiohttp.ClientSession, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.http, self.socket = http, socket

    async def send(self, **content: Any) -> None:
        await self.socket.send_str(json.dumps(content))

    async def hear(self, kind: str) -> dict[str, Any]:
        async with asyncio.timeout(20.0):
            async for message in self.socket:
                if message.type == aiohttp.WSMsgType.TEXT and (content := json.loads(message.data))["type"] == kind:
                    return content
        raise AssertionError(f"no {kind} before the end")

    async def see(self) -> bytes:
        async with asyncio.timeout(20.0):
            async for message in self.socket:
                if message.type == aiohttp.WSMsgType.BINARY:
                    return message.data
        raise AssertionError("no picture before the end")


def connected(address: str, act: Callable[[Client], Awaitable[Any]]) -> Any:
    async def run() -> Any:
        async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as http:
            async with http.get(address) as page:
                assert page.status == 200, await page.text()
            async with http.ws_connect(address.partition("/?")[0] + "/ws") as socket:
                return await act(Client(http, socket))

    return asyncio.run(run())


def base_of(served: Served) -> str:
    return served.addresses["operator"].partition("/?")[0]


def speed(served: Served) -> float:
    return float(np.linalg.norm(served.session.sim.command[0, :3]))


def test_nothing_is_served_without_a_token(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    async def ask() -> list[int]:
        codes = []
        async with aiohttp.ClientSession() as http:
            for path in (
                "/",
                "/?token=",
                "/?token=guess",
                "/app.js",
                "/scene.json",
                "/scene.bin",
                "/ws",
                "/ws?token=a",
            ):
                async with http.get(base_of(served) + path) as answer:
                    codes.append(answer.status)
            with pytest.raises(aiohttp.WSServerHandshakeError):
                await http.ws_connect(base_of(served) + "/ws")
        return codes

    with caplog.at_level(logging.WARNING):
        assert set(asyncio.run(ask())) == {403}
    assert "refused" in caplog.text


def test_files_that_are_not_the_page_are_not_served(served: Served) -> None:
    async def act(client: Client) -> None:
        for path in ("/server.py", "/..%2f..%2fsession.py", "/page.html/../../server.py"):
            async with client.http.get(base_of(served) + path) as answer:
                assert answer.status in (403, 404)

    connected(served.invite(), act)


def test_an_operators_address_admits_one_browser(served: Served) -> None:
    address = served.invite()

    async def act(client: Client) -> None:
        assert (await client.hear("hello"))["role"] == "operator"
        async with aiohttp.ClientSession() as other, other.get(address) as answer:
            assert answer.status == 403
            assert "Another device" in await answer.text()
        await client.send(type="invite")
        invited = (await client.hear("invite"))["operator"]
        async with aiohttp.ClientSession() as other, other.head(invited) as answer:
            assert answer.status == 405  # who only looks does not use the address up
        async with aiohttp.ClientSession() as other, other.get(invited) as answer:
            assert answer.status == 200
        async with client.http.get(base_of(served)) as answer:  # the first one may load the page again
            assert answer.status == 200

    connected(address, act)


def test_a_browser_that_watched_may_become_the_operator(served: Served) -> None:
    address = served.invite()

    async def act(client: Client) -> None:
        assert (await client.hear("hello"))["role"] == "spectator"
        async with client.http.get(address) as answer:
            assert answer.status == 200
        for page in (served.addresses["spectator"], base_of(served)):  # and stays it
            async with client.http.get(page) as answer:
                assert answer.status == 200
        async with client.http.ws_connect(base_of(served) + "/ws") as socket:
            assert (await Client(client.http, socket).hear("hello"))["role"] == "operator"
        async with aiohttp.ClientSession() as other, other.get(address) as answer:
            assert answer.status == 403

    connected(served.addresses["spectator"], act)


def test_a_full_disk_is_told_and_the_session_goes_on(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(served.session.journal, "begin", full)

    async def act(client: Client) -> None:
        await client.send(type="press", button="record")
        assert "No space left on device" in (await client.hear("error"))["message"]
        assert (await client.hear("status"))["state"] == "idle"

    connected(served.invite(), act)
    assert served.error is None


def test_pages_of_other_sites_cannot_connect(served: Served) -> None:
    async def act(client: Client) -> None:
        with pytest.raises(aiohttp.WSServerHandshakeError):
            await client.http.ws_connect(base_of(served) + "/ws", origin="http://evil.example")

    connected(served.invite(), act)


def test_spectators_see_and_cannot_act(served: Served) -> None:
    async def act(client: Client) -> None:
        assert (await client.hear("hello"))["role"] == "spectator"
        assert len(await client.see()) == 16 + 28 * (served.session.sim.model.nbody + 2)
        await client.send(type="press", button="record")
        assert "spectator" in (await client.hear("error"))["message"]
        await client.send(**WALK)
        assert "spectator" in (await client.hear("error"))["message"]
        assert (await client.hear("status"))["state"] == "idle"

    connected(served.addresses["spectator"], act)


def test_garbage_is_refused_and_the_session_goes_on(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    async def act(client: Client) -> None:
        for text in ("garbage", "{}", '{"type": "press", "button": "rm"}'):
            await client.socket.send_str(text)
            assert (await client.hear("error"))["message"]
        await client.socket.send_bytes(b"\0" * 100)
        await client.hear("error")
        await client.send(type="press", button="save")
        assert "'save' while the session is idle" in (await client.hear("error"))["message"]
        assert (await client.hear("status"))["state"] == "idle"

    with caplog.at_level(logging.WARNING):
        connected(served.invite(), act)
    assert "refused a message" in caplog.text


def test_oversized_messages_and_floods_of_garbage_end_the_connection_alone(served: Served) -> None:
    async def oversized(client: Client) -> None:
        await client.socket.send_str("x" * (protocol.MAX_MESSAGE + 1))
        async with asyncio.timeout(20.0):
            async for _ in client.socket:
                pass
        assert client.socket.close_code == 1009

    async def flood(client: Client) -> None:
        for _ in range(MAX_REFUSED + 2):
            await client.socket.send_str("garbage")
        async with asyncio.timeout(20.0):
            async for _ in client.socket:
                pass

    connected(served.invite(), oversized)
    connected(served.invite(), flood)

    async def act(client: Client) -> None:
        assert (await client.hear("status"))["state"] == "idle"

    connected(served.invite(), act)


def test_silence_and_a_closed_tab_stop_the_robot(served: Served) -> None:
    async def until(walks: bool, limit: int) -> int:
        """Return how many steps of 0.1 s it took until the robot walks or stands."""
        first = served.session.sim.time[0]
        async with asyncio.timeout(30.0):
            while (speed(served) > 0.0) != walks:
                await asyncio.sleep(0.002)
        steps = round((served.session.sim.time[0] - first) / 0.1)
        assert steps <= limit
        return steps

    async def walk(client: Client) -> None:
        for _ in range(400):
            await client.send(**WALK)
            if speed(served) > 0.0:
                return
            await asyncio.sleep(0.02)
        raise AssertionError("it does not walk")

    async def act(client: Client) -> None:
        await walk(client)
        await until(False, 3)  # silence
        await walk(client)
        await client.socket.close()
        await until(False, 3)  # a closed tab

    connected(served.invite(), act)


@pytest.mark.slow
def test_a_slow_network_that_loses_packets_neither_throws_the_hands_nor_ends_the_session(served: Served) -> None:
    """500 ms each way, and a fifth of what is sent comes later still: the robot follows in pieces, and stands alone."""
    targets, stood = [], []

    async def look() -> None:
        while True:
            targets.append(served.session.targets[1, :3, 3].copy())
            await asyncio.sleep(0.05)

    async def act(port: int) -> None:
        address = served.invite().replace(str(served.server.port), str(port))
        async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as http:
            async with http.get(address) as page:
                assert page.status == 200
            async with http.ws_connect(address.partition("/?")[0] + "/ws") as socket:
                client = Client(http, socket)
                looking = asyncio.create_task(look())
                for number in range(180):  # 6 s: the hand goes up by 0.2 m in 2 s, and stays
                    hand = {"pose": [0, 1 + 0.1 * min(number / 30, 2.0), 0, 1, 0, 0, 0], "engaged": True}
                    await client.send(type="input", seq=number, hands={"right": hand}, walk=[0.5, 0, 0])
                    await asyncio.sleep(1 / 30)
                walked = asyncio.get_running_loop().time()
                while speed(served) > 0.0 or not stood:
                    stood.append(speed(served) == 0.0)
                    await asyncio.sleep(0.01)
                    assert asyncio.get_running_loop().time() - walked < 3.0
                looking.cancel()
                await client.send(type="press", button="record")
                while (await client.hear("status"))["state"] != "recording":
                    pass
                await client.send(type="press", button="discard")
                while (await client.hear("status"))["state"] != "idle":
                    pass

    async def run() -> None:
        async with slow_network(served.server.port, 0.5, 0.2) as port:
            await act(port)

    connected(served.invite(), lambda client: client.send(type="press", button="discard"))
    asyncio.run(run())
    ways = np.linalg.norm(np.diff(targets, axis=0), axis=1)
    assert ways.max() <= RETURN_M + 0.05  # what the clutch lets a hand catch up with, and a step of the walk
    assert targets[-1][2] - targets[0][2] == pytest.approx(0.2, abs=0.03)


def test_certificates_are_made_on_the_spot() -> None:
    context, fingerprint = make_context(["192.0.2.7", "robot.local"])
    assert len(fingerprint) == 32 * 3 - 1
    assert make_context(["192.0.2.7"])[1] != fingerprint
    assert context.minimum_version >= 0x0303


@pytest.mark.slow
def test_the_command_prints_its_address_and_offers_what_a_kill_left(tmp_path: Path) -> None:
    root = tmp_path / "lift"
    command = [sys.executable, "-m", "lerobot_demohlm.cli", "record", "--task", "LiftBox", "--teleop", "web"]
    command += ["--port", "0", "--trial", "0", "--root", str(root)]

    def start() -> tuple[subprocess.Popen[str], dict[str, str]]:
        heeds = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # a shell's background jobs are born deaf to it
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, preexec_fn=heeds
        )
        assert process.stdout is not None
        return process, json.loads(process.stdout.readline())

    async def record(client: Client) -> int:
        await client.send(type="press", button="record")
        while (status := await client.hear("status"))["tick"] < 12:
            pass
        return status["tick"]

    process, addresses = start()
    ticks = connected(addresses["operator"], record)
    process.send_signal(signal.SIGKILL)
    process.wait()

    async def recover(client: Client) -> dict[str, Any]:
        unfinished = (await client.hear("status"))["unfinished"]
        await client.send(type="press", button="recover")
        while (status := await client.hear("status"))["state"] != "review":
            pass
        return status | {"unfinished": unfinished}

    process, addresses = start()
    status = connected(addresses["operator"], recover)
    process.send_signal(signal.SIGINT)
    assert process.wait(30.0) == 2
    assert status["unfinished"] >= ticks
    assert status["tick"] == status["unfinished"]
    assert "no hand touches anything" in status["verdict"]["refusal"]
    assert not root.exists()


@pytest.mark.parametrize(("given", "same"), [("abc", True), ("abd", False), ("ab\u00e9", False), ("\udc80", False)])
def test_tokens_are_compared_whatever_a_browser_sends(given: str, same: bool) -> None:
    assert _equal("abc", given) is same
