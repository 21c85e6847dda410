"""Pictures of other processes -> poses: the server loop, and this project's tracker behind it as the reference."""

import logging
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
import zmq

from gym_demohlm import poses
from gym_demohlm.errors import DemoHLMError, SceneError, UnknownNameError
from gym_demohlm.perception import masks
from gym_demohlm.perception.camera import Intrinsics, whole
from gym_demohlm.perception.meshes import ObjectMesh, object_meshes
from gym_demohlm.perception.object_trackers import ObjectTrackers, doors
from gym_demohlm.perception.wire import Answer, Request, pack_answers, unpack_request
from gym_demohlm.registry import get_task
from gym_demohlm.scene import build_scene

_SESSIONS = 256  # episodes that are remembered
_LEAST_PATCH = 40  # px
_log = logging.getLogger(__name__)
_TURN_MS = 200  # how often a waiting server looks whether it is to stop


class Backend(Protocol):
    """What estimates poses."""

    def __call__(self, request: Request) -> Sequence[Answer]:
        """Return an answer for each object of the request, in its order."""
        ...


@dataclass(frozen=True, kw_only=True)
class _Form:
    """A task as a region has it: the shapes of its objects, and the scene in which they stand."""

    meshes: dict[str, ObjectMesh]
    model: mujoco.MjModel


@dataclass(frozen=True, kw_only=True)
class _Session:
    """An episode: its objects, and where the hands were in the last picture."""

    followed: ObjectTrackers
    hands: dict[str, np.ndarray]


class TrackerBackend:
    """This project's tracker: one for each object of each session."""

    def __init__(self) -> None:
        self._forms: dict[tuple[str, str], _Form] = {}
        self._sessions: OrderedDict[tuple[str, ...], _Session] = OrderedDict()

    def __call__(self, request: Request) -> list[Answer]:
        """Track the objects in a picture.

        Masks that were not sent are found by colour. Where an object is white, grey or black in part, colour tells
        nothing (``masks.refuse_grey``): then no answer is valid, and each says why.

        Raises:
            UnknownNameError: No such task or region, or the task has no such object.
        """
        form = self._form(request)
        meshes = [form.meshes[name] for name in request.objects]
        grey = masks.grey(meshes) if request.masks is None else []
        if grey:
            return [_unseen(f"colour cannot tell {', '.join(grey)} from walls: send masks")] * len(meshes)
        height, width = request.depth.shape
        K = request.K
        known = Intrinsics(
            width=width, height=height, focal=float(K[0, 0]), center_u=float(K[0, 2]), center_v=float(K[1, 2])
        )
        session = (request.session, request.task, request.region, *request.objects)
        past = self._sessions.pop(session, None)
        followed = ObjectTrackers(meshes, known, doors(form.model, meshes)) if past is None else past.followed
        found = request.masks or [
            masks.component_near(masks.color(request.color, mesh.colors), None, _LEAST_PATCH) for mesh in meshes
        ]
        followed.update(
            request.depth,
            dict(enumerate(found)),
            whole(known),
            request.T_odom_optical,
            request.dt_s,
            hands_before={} if past is None else past.hands,
            hands=request.hands,
            robot=np.zeros((height, width), bool),  # the server is not told which pixels are the robot's
        )
        self._sessions[session] = _Session(followed=followed, hands=dict(request.hands))
        while len(self._sessions) > _SESSIONS:
            self._sessions.popitem(last=False)
        T_optical_odom = poses.invert(request.T_odom_optical)
        return [
            Answer(T_optical_object=T_optical_odom @ track.T_odom_object, valid=True)
            if track is not None and track.valid
            else _unseen("an object that is not seen")
            for track in (tracker.track for tracker in followed.trackers)
        ]

    def _form(self, request: Request) -> _Form:
        """Return the task's form, which has each object of the request."""
        key = request.task, request.region
        if key not in self._forms:
            task = get_task(request.task)
            task = task.at(request.region) if request.region else task
            model = build_scene(task).model
            self._forms[key] = _Form(meshes={mesh.name: mesh for mesh in object_meshes(model, task)}, model=model)
        form = self._forms[key]
        for name in request.objects:
            if name not in form.meshes:
                raise UnknownNameError("object", name, form.meshes)
        return form


def _unseen(reason: str) -> Answer:
    return Answer(T_optical_object=np.eye(4), valid=False, reason=reason)


BACKENDS = {"tracker": TrackerBackend}


def make_backend(name: str) -> Backend:
    """Return a backend by its name.

    Raises:
        UnknownNameError: There is no such backend.
    """
    if name not in BACKENDS:
        raise UnknownNameError("backend", name, BACKENDS)
    return BACKENDS[name]()


def serve(
    backend: Backend, address: str, ready: Callable[[str], None] | None = None, stop: Callable[[], bool] = lambda: False
) -> None:
    """Answer requests until told to stop.

    Args:
        backend: What estimates poses.
        address: Where to listen, such as ``tcp://127.0.0.1:5570``; port ``*`` takes a free one.
        ready: Called with the address once it listens.
        stop: Asked five times a second.

    Raises:
        SceneError: Nothing can listen there.
    """
    context = zmq.Context()
    socket = context.socket(zmq.REP)
    socket.linger = 0
    try:
        try:
            socket.bind(address)
        except zmq.ZMQError as error:
            raise SceneError(f"the address {address} ({error})", "one that is free", "choose another port") from error
        if ready is not None:
            ready(socket.getsockopt_string(zmq.LAST_ENDPOINT))
        while not stop():
            if socket.poll(_TURN_MS):
                socket.send(_answered(backend, socket.recv_multipart()))
    finally:
        context.destroy(linger=0)


def _answered(backend: Backend, parts: list[bytes]) -> bytes:
    """Return the answer to a message; one that cannot be read, or that fails, gets the reason instead of poses."""
    began = time.perf_counter()
    request = None
    try:
        request = unpack_request(parts)
        return pack_answers(request.frame, list(backend(request)), 1e3 * (time.perf_counter() - began))
    except Exception as error:  # whatever a message does, the next one is answered too
        if not isinstance(error, DemoHLMError):
            _log.warning("a request that failed", exc_info=error)
        answers = [_unseen(str(error))] * (len(request.objects) if request is not None else 0)
    frame = -1 if request is None else request.frame
    return pack_answers(frame, answers, 1e3 * (time.perf_counter() - began))
