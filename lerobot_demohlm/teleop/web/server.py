"""A recording session -> served to browsers: the page, the scene, poses at 50 Hz, and the operator's controls back.

Two threads: one steps the world against the clock, one talks to browsers. Between them lie slots that hold the newest
value, never queues: a slow browser misses frames, and the world never waits for it.
"""

import asyncio
import contextlib
import hmac
import json
import logging
import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from aiohttp import WSMsgType, web

from gym_demohlm.errors import DemoHLMError, DemonstrationError
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from lerobot_demohlm.demonstrations.demonstration import pose_numbers
from lerobot_demohlm.teleop.clutch import Controls
from lerobot_demohlm.teleop.operator import SceneView
from lerobot_demohlm.teleop.realtime import RealTimeWorld, body_poses
from lerobot_demohlm.teleop.status import SAVED, Status
from lerobot_demohlm.teleop.web import protocol, scene
from lerobot_demohlm.teleop.web.certificate import make_context
from lerobot_demohlm.teleop.web.inputs import Inputs

PAGE = Path(__file__).parent / "page"
FILES = {
    "": ("page.html", "text/html"),
    "page.css": ("page.css", "text/css"),
    "app.js": ("app.js", "text/javascript"),
    "scene.js": ("scene.js", "text/javascript"),
    "controls.js": ("controls.js", "text/javascript"),
}
LOCAL = ("localhost", "127.0.0.1", "::1")
MAX_CLIENTS = 16
PAUSED_S = 0.05  # between looks at the buttons while the world stands still
GOODBYE_S = 1.0  # for the browsers to hear that the demonstration is saved
MAX_REFUSED = 200  # messages of one browser, after which it is cut off
NO_TOKEN = (
    "This address needs a token that is valid; an operator's admits one browser.\n"
    "Press 'Another device' on an operator's page for one more, or start the command again.\n"
)
_POLICY = "default-src 'self'; connect-src 'self'; img-src 'self' data:; style-src 'self'; frame-ancestors 'none'"

_log = logging.getLogger(__name__)


@dataclass(eq=False)
class _Client:
    """A browser."""

    role: str
    frame: bytes | None = None
    texts: deque[str] = field(default_factory=lambda: deque(maxlen=8))
    news: asyncio.Event = field(default_factory=asyncio.Event)
    refused: int = 0

    def tell(self, text: str) -> None:
        self.texts.append(text)
        self.news.set()

    def show(self, content: bytes) -> None:
        self.frame = content
        self.news.set()


class Session(Protocol):
    """What is served: ``RecordingSession``, or the world of a robot that LeRobot records."""

    @property
    def task(self) -> Task:
        """The task."""
        ...

    @property
    def sim(self) -> Simulation:
        """One world of it."""
        ...

    @property
    def state(self) -> str:
        """See ``Status``."""
        ...

    @property
    def paused(self) -> bool:
        """Whether the world stands still."""
        ...

    @property
    def targets(self) -> np.ndarray:
        """(2, 4, 4) what is asked of the palms."""
        ...

    def __len__(self) -> int:
        """Return the number of recorded steps."""
        ...

    def view(self) -> SceneView:
        """Return what the operator sees."""
        ...

    def press(self, button: str) -> None:
        """Do what a button stands for."""
        ...

    def advance(self, controls: Controls) -> None:
        """Make a step of 0.1 s."""
        ...

    def status(self) -> Status:
        """Return what the operator needs to know now."""
        ...


class TeleopServer:
    """Serves one session until its demonstration is saved.

    Args:
        session: What is served.
        host: Where to listen; names other than of this machine alone get https.
        port: Where to listen; 0 for any that is free.
        announce: Given one line of JSON with the addresses.
        pace: What holds the world to the clock, where somebody else steps it.
        step: Waits for that other's next step; the session is not waited for then.
    """

    def __init__(
        self,
        session: Session,
        host: str = "localhost",
        port: int = 8012,
        announce: Callable[[str], None] = print,
        pace: RealTimeWorld | None = None,
        step: Callable[[], None] | None = None,
    ) -> None:
        sim = session.sim
        self.session, self.sim, self.host, self.port, self._announce = session, sim, host, port, announce
        self.world, self._other = pace or RealTimeWorld(sim), step
        self.inputs = Inputs()
        self._package = scene.package(sim.model, session.task)
        self._colors = np.array([scene.geom_rgba(sim.model, geom) for geom in self._package.geoms])
        self._tokens = {secrets.token_urlsafe(24): "operator", secrets.token_urlsafe(24): "spectator"}
        self._cookies: dict[str, str] = {}
        self._clients: set[_Client] = set()
        self._presses: deque[tuple[_Client, str]] = deque()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self._painted: dict[int, list[float]] = {}  # colours that the task's memory has changed, by geom
        self.world.after_tick = self._after_tick

    # The world's thread

    def _run_world(self) -> None:
        try:
            while not self._stop.is_set():
                self._step()
                if self.session.state == SAVED:
                    self._publish_status()
                    break
        except BaseException as error:
            self._error = error
            _log.exception("the world has stopped")
        finally:
            if self._loop is not None:
                self._loop.call_soon_threadsafe(self._finished.set)

    def _step(self) -> None:
        session = self.session
        if self._other is not None:
            self._other()
        elif session.paused:
            self.world.start()
            self._stop.wait(PAUSED_S)
        else:
            self.world.wait()
        while self._presses:
            client, button = self._presses.popleft()
            self._press(client, button)
        controls = self.inputs.latest()
        stood = session.paused
        session.advance(controls)
        if stood:
            self._publish_frame()
        self._publish_status()

    def _press(self, client: _Client, button: str) -> None:
        try:
            self.session.press(button)
        except (DemoHLMError, OSError) as error:
            if isinstance(error, OSError):
                error = DemonstrationError(str(error), "a folder that can be written", "make room, then press again")
            _log.info("%s: %s", button, error)
            self._send(client, {"type": "error", "message": str(error)})
        if self._other is None:
            self.world.start()

    def _after_tick(self, tick: int) -> None:
        if tick == 0:
            self.inputs.latencies.applied(time.time())
        self._publish_frame()

    def _publish_frame(self) -> None:
        targets = self.session.targets
        content = protocol.frame(time.time(), len(self.session), body_poses(self.sim), pose_numbers(targets))
        self._painted = self._changed_colors()
        self._in_loop(lambda: [client.show(content) for client in self._clients])

    def _publish_status(self) -> None:
        status = self.session.status()
        text = protocol.status_message(
            status,
            device=self.inputs.device,
            latency=self.inputs.latencies.summary(),
            factor=round(self.world.factor, 3),
            late_s=round(self.world.late_s, 2),
            poses=self._poses(),
            colors=self._painted,
            clients=len(self._clients),
        )
        self._in_loop(lambda: [client.tell(text) for client in self._clients])

    def _poses(self) -> dict[str, list[float]]:
        view = self.session.view()
        named = {"pelvis": view.T_world_pelvis, "head": view.T_world_head} | dict(view.T_world_objects)
        named |= {"left_palm": view.T_world_hands[0], "right_palm": view.T_world_hands[1]}
        targets = self.session.targets
        named |= {"left_target": targets[0], "right_target": targets[1]}
        return {name: [round(value, 6) for value in pose_numbers(T).tolist()] for name, T in named.items()}

    def _changed_colors(self) -> dict[int, list[float]]:
        """Return the colours that differ from those in the scene, as the world was drawn last."""
        if self.session.task.memory is None:
            return {}
        now = np.array([scene.geom_rgba(self.sim.model, geom) for geom in self._package.geoms])
        changed = np.flatnonzero(np.abs(now - self._colors).max(axis=1) > 1e-3)
        return {int(index): [round(float(value), 3) for value in now[index]] for index in changed}

    def _send(self, client: _Client, content: dict[str, Any]) -> None:
        text = json.dumps(content)
        self._in_loop(lambda: client.tell(text))

    def _in_loop(self, action: Callable[[], object]) -> None:
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has been closed: nobody listens any more
                self._loop.call_soon_threadsafe(action)

    # The browsers' thread

    def stop(self) -> None:
        """Stop serving, from any thread."""
        self._stop.set()

    def run(self) -> None:
        """Serve until the demonstration is saved, or Ctrl-C."""
        asyncio.run(self.serve())

    async def serve(self) -> None:
        """Serve until the demonstration is saved, or this is cancelled."""
        self._loop = asyncio.get_running_loop()
        self._finished = asyncio.Event()
        application = web.Application(client_max_size=protocol.MAX_MESSAGE)
        for path, answer in (
            ("/ws", self._socket),
            ("/scene.json", self._scene_json),
            ("/scene.bin", self._scene_bin),
            ("/{name:[a-z.]*}", self._file),
        ):
            application.router.add_get(path, answer, allow_head=False)  # who only looks must not use up a token
        runner = web.AppRunner(application, access_log=None, shutdown_timeout=1.0)
        await runner.setup()
        context, fingerprint = (None, None) if self.host in LOCAL else make_context(_addresses(self.host))
        site = web.TCPSite(runner, self.host, self.port, ssl_context=context)
        with _port_in_errors(self.host, self.port):
            await site.start()
        assert site._server is not None
        self.port = runner.addresses[0][1]
        self._announce(json.dumps(self._addresses("serving") | {"certificate_sha256": fingerprint}))
        thread = threading.Thread(target=self._run_world, name="world", daemon=True)
        thread.start()
        try:
            await self._finished.wait()
            if self.session.state == SAVED:
                await asyncio.sleep(GOODBYE_S)
        finally:
            self._stop.set()
            await asyncio.to_thread(thread.join, 5.0)
            await runner.cleanup()
            self._loop = None
        if self._error is not None:
            raise self._error

    def _addresses(self, event: str) -> dict[str, Any]:
        scheme = "http" if self.host in LOCAL else "https"
        host = _addresses(self.host)[0]
        by_role = {role: token for token, role in self._tokens.items()}
        base = f"{scheme}://{f'[{host}]' if ':' in host else host}:{self.port}/?token="
        return {"event": event, "task": self.session.task.name} | {role: base + by_role[role] for role in by_role}

    def _admit(self, request: web.Request) -> tuple[str | None, str | None]:
        """Return the role of a request and the cookie to set, if any; an operator's token admits one browser."""
        cookie = request.cookies.get(self._cookie_name, "")
        admitted = next((role for known, role in self._cookies.items() if _equal(known, cookie)), None)
        token = request.query.get("token", "")
        for known, role in list(self._tokens.items()):
            if _equal(known, token) and (admitted is None or (admitted, role) == ("spectator", "operator")):
                if role == "operator":
                    del self._tokens[known]
                new = secrets.token_urlsafe(24)
                self._cookies[new] = role
                return role, new
        return admitted, None

    @property
    def _cookie_name(self) -> str:
        return f"demohlm_{self.port}"

    def _answer(self, request: web.Request, make: Callable[[], web.Response]) -> web.Response:
        role, cookie = self._admit(request)
        if role is None:
            _log.warning("refused %s from %s: no valid token", request.path, request.remote)
            return web.Response(status=403, text=NO_TOKEN)
        response = make()
        response.headers["Content-Security-Policy"] = _POLICY
        response.headers["Cache-Control"] = "no-store"
        response.headers["Referrer-Policy"] = "no-referrer"
        if cookie is not None:
            secure = request.scheme == "https"
            response.set_cookie(self._cookie_name, cookie, httponly=True, samesite="Strict", secure=secure)
        return response

    async def _file(self, request: web.Request) -> web.Response:
        name = request.match_info["name"]
        if name not in FILES:
            return web.Response(status=404, text="There is no such file.\n")
        path, kind = FILES[name]
        content = (PAGE / path).read_text()
        return self._answer(request, lambda: web.Response(text=content, content_type=kind))

    async def _scene_json(self, request: web.Request) -> web.Response:
        text = self._package.description
        return self._answer(request, lambda: web.Response(text=text, content_type="application/json"))

    async def _scene_bin(self, request: web.Request) -> web.Response:
        body = self._package.buffers
        return self._answer(request, lambda: web.Response(body=body, content_type="application/octet-stream"))

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        role, _ = self._admit(request)
        origin = request.headers.get("Origin")
        foreign = origin is not None and origin.partition("://")[2] != request.host
        if role is None or foreign or len(self._clients) >= MAX_CLIENTS:
            _log.warning("refused a connection from %s: %s", request.remote, "token, origin or too many")
            return web.Response(status=403, text="refused\n")
        connection = web.WebSocketResponse(max_msg_size=protocol.MAX_MESSAGE, heartbeat=5.0, compress=False)
        await connection.prepare(request)
        client = _Client(role=role)
        hello = {
            "type": "hello",
            "version": protocol.VERSION,
            "role": role,
            "task": self.session.task.name,
            "description": self.session.task.description,
            "grippers": self.session.task.hands == "gripper",
        }
        client.tell(json.dumps(hello))
        self._clients.add(client)
        sender = asyncio.create_task(self._send_news(client, connection))
        try:
            async for message in connection:
                if message.type == WSMsgType.TEXT:
                    self._receive(client, message.data)
                elif message.type == WSMsgType.ERROR:
                    _log.warning("a connection from %s broke off: %s", request.remote, connection.exception())
                else:
                    self._refuse(client, "a binary message")
                if client.refused > MAX_REFUSED:
                    _log.warning("cut off %s: too many messages refused", request.remote)
                    break
        finally:
            self._clients.discard(client)
            self.inputs.gone(client)
            sender.cancel()
            if connection.close_code is not None and connection.close_code not in (1000, 1001):
                _log.warning("a connection from %s was closed with code %s", request.remote, connection.close_code)
        return connection

    async def _send_news(self, client: _Client, connection: web.WebSocketResponse) -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                await client.news.wait()
                client.news.clear()
                while client.texts:
                    await connection.send_str(client.texts.popleft())
                content, client.frame = client.frame, None
                if content is not None:
                    await connection.send_bytes(content)

    def _receive(self, client: _Client, text: str) -> None:
        try:
            message = protocol.parse(text)
        except protocol.ProtocolError as error:
            self._refuse(client, str(error))
            return
        if isinstance(message, protocol.Ping):
            client.tell(json.dumps({"type": "pong", "t": message.time, "server": time.time()}))
        elif client.role != "operator":
            self._refuse(client, "a spectator who wants to act")
        elif isinstance(message, protocol.Input):
            self.inputs.put(client, message)
        elif isinstance(message, protocol.Press):
            self._presses.append((client, message.button))
        else:
            self._tokens[secrets.token_urlsafe(24)] = "operator"
            client.tell(json.dumps(self._addresses("invite") | {"type": "invite"}))

    def _refuse(self, client: _Client, why: str) -> None:
        client.refused += 1
        if client.refused <= 5 or client.refused % 50 == 0:
            _log.warning("refused a message (%d of this browser): %s", client.refused, why)
        client.tell(json.dumps({"type": "error", "message": why}))


def require_port(host: str, port: int) -> None:
    """Look whether a port can be listened at, before a robot walks to its place.

    Raises:
        DemonstrationError: It cannot.
    """

    async def listen() -> None:
        (await asyncio.get_running_loop().create_server(asyncio.Protocol, host, port)).close()

    with _port_in_errors(host, port):
        asyncio.run(listen())


@contextlib.contextmanager
def _port_in_errors(host: str, port: int) -> Iterator[None]:
    """Have errors of listening name the port and its option."""
    try:
        yield
    except OSError as error:
        raise DemonstrationError(
            f"port {port} of {host}, at which nobody can listen ({error.strerror or error})",
            "one that is free",
            "choose another --port (with lerobot, --teleop.port), or 0 for any",
        ) from error


def _addresses(host: str) -> list[str]:
    """Return the names under which a host's server is reached, the best one first."""
    if host not in ("0.0.0.0", "::", ""):
        return [host]
    found = []
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # sends nothing; tells which address this machine would use
        found.append(probe.getsockname()[0])
    return [*found, socket.gethostname(), "localhost"]


def _equal(known: str, given: str) -> bool:
    """Compare in a time that tells nothing; whatever a browser sends."""
    return hmac.compare_digest(known.encode(), given.encode(errors="replace"))
