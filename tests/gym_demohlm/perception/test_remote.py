"""A pose server: the reference one, and ones that are late, silent, wrong or killed."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.perception import pose_client, wire
from gym_demohlm.perception.meshes import known_meshes
from gym_demohlm.perception.pose_client import LATE, NO_ANSWER
from gym_demohlm.perception.pose_server import TrackerBackend, make_backend
from gym_demohlm.perception.pose_server import _answered as answered
from tests.helpers.pose_servers import Reply, replying, serving, told

STEPS = 4


def _episode(address: str, steps: int = STEPS, timeout_s: float = 20.0) -> tuple[list[np.ndarray], dict[str, int]]:
    """Return what is observed of the object in some steps of a robot that stands, and what went wrong."""
    env = gym.make("DemoHLM/GraspCube-v0", perception=f"remote,address={address},timeout_s={timeout_s}").unwrapped
    observation, _ = env.reset(seed=3, options={"region": "R1"})
    seen = [observation["environment_state"]]
    action = env.get_wrapper_attr("sim").command[0].astype(np.float32)
    for _ in range(steps):
        seen.append(env.step(action)[0]["environment_state"])
    faults = env.get_wrapper_attr("perception_faults")()
    env.close()
    return seen, faults


def test_the_reference_server_tells_poses_near_the_truth() -> None:
    with serving(TrackerBackend()) as address:
        seen, faults = _episode(address)
    exact = gym.make("DemoHLM/GraspCube-v0").unwrapped
    true = exact.reset(seed=3, options={"region": "R1"})[0]["environment_state"]
    exact.close()
    assert not faults
    assert 0.0 < np.abs(seen[0] - true)[:3].max() < 0.02


def _changed(change: Callable[[dict], None]) -> Reply:
    return lambda request: told(request, change=change if request.frame >= 2 else lambda answer: None)


def _not_finite(answer: dict) -> None:
    answer["objects"][0]["T_optical_object"][3] = float("nan")


def _too_large(answer: dict) -> None:
    answer["objects"][0]["T_optical_object"][3] = 10**400


def _shorter(answer: dict) -> None:
    answer["objects"][0]["T_optical_object"].pop()


def _stretched(answer: dict) -> None:
    answer["objects"][0]["T_optical_object"][0] = 1.5


def _fewer(answer: dict) -> None:
    answer["objects"].pop()


def _lost(answer: dict) -> None:
    answer["objects"][0].update(valid=False, reason="the mask is empty")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (_not_finite, "a pose that is not finite"),
        (_too_large, "no pose in an answer"),
        (_shorter, "a pose of a wrong shape"),
        (_stretched, "a pose that is no rotation and shift"),
        (_fewer, "another number of objects"),
        (_lost, "the mask is empty"),
        (lambda answer: answer.pop("objects"), "no answer in JSON"),
        (lambda answer: answer.update(frame=math.inf), "no answer in JSON"),
        (lambda answer: answer.update(frame=999), "an answer to another picture"),
    ],
)
def test_what_cannot_be_used_is_counted_and_the_last_pose_held(change: Callable[[dict], None], reason: str) -> None:
    with replying(_changed(change)) as address:
        seen, faults = _episode(address)
    assert faults == {reason: STEPS - 1}  # from the third picture on; the first is that of the reset
    assert np.abs(seen[-1][:3] - seen[1][:3]).max() < 0.02  # held in odometry coordinates: the camera sways
    assert all(np.isfinite(row).all() for row in seen)


def test_a_silent_server_is_waited_for_once_and_the_episode_goes_on() -> None:
    with replying(lambda request: None) as address:
        seen, faults = _episode(address, steps=3, timeout_s=0.2)
    assert faults == {NO_ANSWER: 4} and all(np.isfinite(row).all() for row in seen)


def test_a_server_that_was_killed_leaves_the_last_pose_and_one_in_its_place_is_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pose_client, "GIVEN_UP_S", 0.3)
    answered = []

    def dying(request: wire.Request) -> bytes | None:
        answered.append(request.frame)
        return told(request) if len(answered) <= 2 else None

    with replying(dying) as address:
        seen, faults = _episode(address, steps=24, timeout_s=0.05)
    assert faults[NO_ANSWER] >= 20 and len(seen) == 25
    assert np.abs(seen[-1][:3] - seen[1][:3]).max() < 0.03
    assert len(answered) >= 4 and max(answered) >= 10, "it was called anew"


def test_an_answer_that_comes_late_is_taken_as_of_the_time_of_its_picture() -> None:
    asked: list[tuple[int, float]] = []

    def late(request: wire.Request) -> bytes:
        asked.append((request.frame, request.dt_s))
        return told(request, wait_s=0.3 if request.frame == 1 else 0.0)

    with replying(late) as address:
        seen, faults = _episode(address, steps=60, timeout_s=0.1)
    assert faults.get(LATE, 0) >= 1 and faults[NO_ANSWER] >= 1
    assert all(np.isfinite(row).all() for row in seen)
    frames, dt_s = np.array(asked).T
    skipped = np.diff(frames)
    np.testing.assert_allclose(dt_s[1:], 0.1 * skipped)  # since the last picture that the server was sent
    assert skipped.max() > 1


def test_a_request_survives_the_wire() -> None:
    rng = np.random.default_rng(0)
    request = wire.Request(
        session="a", frame=3, task="GraspCube", objects=("cube",), K=np.diag([600.0, 600, 1]), T_odom_optical=np.eye(4),
        hands={"left": np.eye(4)}, color=np.full((48, 64, 3), 120, np.uint8),
        depth=rng.uniform(0.2, 6.0, (48, 64)).astype(np.float32), masks=(rng.random((48, 64)) > 0.5,),
    )  # fmt: skip
    back = wire.unpack_request(wire.pack_request(replace(request, dt_s=0.04, region="R4")))
    assert (back.dt_s, back.region) == (0.04, "R4")
    np.testing.assert_allclose(back.depth, request.depth, atol=0.5 * wire.DEPTH_UNIT + 1e-6)
    assert back.masks is not None and (back.masks[0] == request.masks[0]).all()  # pyright: ignore[reportOptionalSubscript]
    assert back.objects == ("cube",) and back.frame == 3 and np.abs(back.color.astype(int) - 120).max() <= 2
    assert wire.unpack_request(wire.pack_request(replace(request, masks=None))).masks is None


def _request() -> wire.Request:
    return wire.Request(
        session="a", frame=0, task="GraspCube", objects=("cube",), K=np.eye(3), T_odom_optical=np.eye(4), hands={},
        color=np.zeros((48, 64, 3), np.uint8), depth=np.ones((48, 64), np.float32), masks=(np.zeros((48, 64), bool),),
    )  # fmt: skip


@pytest.mark.parametrize("part", range(4))
def test_a_damaged_request_is_an_error(part: int) -> None:
    parts = wire.pack_request(_request())
    parts[part] = parts[part][: len(parts[part]) // 2] if part != 1 else b"no jpeg"
    with pytest.raises(SceneError):
        wire.unpack_request(parts)


@pytest.mark.parametrize("change", [{"frame": math.inf}, {"T_odom_optical": [10**400] * 16}])
def test_numbers_that_are_too_large_are_an_error(change: dict[str, Any]) -> None:
    header, *others = wire.pack_request(_request())
    with pytest.raises(SceneError, match="cannot be read"):
        wire.unpack_request([json.dumps(json.loads(header) | change).encode(), *others])


def test_the_server_is_told_of_the_shapes_that_objects_have_in_r4() -> None:
    asked: list[wire.Request] = []

    def noted(request: wire.Request) -> bytes:
        asked.append(request)
        return told(request)

    with replying(noted) as address:
        env = gym.make("DemoHLM/LiftBox-v0", region="R4", perception=f"remote,address={address},timeout_s=20").unwrapped
        env.reset(seed=0)
        (true,) = known_meshes(env.get_wrapper_attr("sim").scene)
        env.close()
    backend, request = TrackerBackend(), asked[0]
    forms = [backend._form(replace(request, region=region)) for region in ("", request.region)]
    plain, wide = (form.meshes["box"] for form in forms)
    np.testing.assert_array_equal(wide.vertices, true.vertices)
    assert np.ptp(wide.vertices, axis=0).tolist() != np.ptp(plain.vertices, axis=0).tolist()
    with pytest.raises(UnknownNameError, match="R1, R2, R3, R4"):
        backend(replace(request, region="R9"))


def test_whatever_a_message_does_the_next_one_is_answered() -> None:
    class Odd:
        def __call__(self, request: wire.Request) -> list[wire.Answer]:
            raise ZeroDivisionError("no such thing")

    asked = _request()
    empty = wire.pack_request(asked)
    empty[1] = b""
    nested = [b"[" * 100_000, *wire.pack_request(asked)[1:]]
    for parts in ([], [b""], empty, nested, wire.pack_request(asked)):
        frame, answers = json.loads(answered(Odd(), parts))["frame"], json.loads(answered(Odd(), parts))["objects"]
        assert all(not answer["valid"] and answer["reason"] for answer in answers)
    assert (frame, answers[0]["reason"]) == (asked.frame, "no such thing")


def test_a_session_of_other_objects_is_another_one() -> None:
    backend, asked = TrackerBackend(), _request()
    assert len(backend(asked)) == 1
    masks = (np.zeros((48, 64), bool),) * 2
    stacked = replace(asked, task="StackCube", objects=("red", "blue"), masks=masks)
    assert len(backend(stacked)) == 2


def test_an_unknown_backend_is_an_error() -> None:
    with pytest.raises(UnknownNameError, match="tracker"):
        make_backend("foundationpose")
