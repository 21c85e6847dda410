"""The public peer runs under our protocol with its own gains, pose and clock; without its package the error says so."""

import importlib.util
import json

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.robot import g1
from gym_demohlm.timing import CONTROL_DT
from gym_demohlm.wbc.evaluation import benchmark, peer

_INSTALLED = all(importlib.util.find_spec(module) for module in ("holosoma_inference", "onnxruntime"))
needs_peer = pytest.mark.skipif(not _INSTALLED, reason="needs holosoma-inference")


def _sensed(count: int, seed: int) -> Proprioception:
    rng = np.random.default_rng(seed)
    quat = rng.normal([1, 0, 0, 0], 0.1, (count, 4))
    return Proprioception(
        quat_wxyz=quat / np.linalg.norm(quat, axis=1, keepdims=True),
        gyro=rng.normal(0, 0.5, (count, 3)),
        q=g1.HOME + rng.normal(0, 0.1, (count, 29)),
        dq=rng.normal(0, 0.5, (count, 29)),
    )


def test_without_the_package_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SceneError, match=r"uv pip install"):
        peer.load_policy("holosoma")


def test_an_unknown_peer_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="holosoma-ppo"):
        peer.load_policy("holosoma-pp")


def test_gravity_is_down_seen_from_the_pelvis() -> None:
    quat = _sensed(5, 0).quat_wxyz
    expected = -poses.quat_to_matrix(quat)[:, 2]
    np.testing.assert_allclose(peer._gravity(quat), expected, atol=1e-12)


def test_clock_turns_once_a_period_rests_and_starts_with_the_left_foot() -> None:
    clock, walk, still = np.array([[0.0, np.pi, 0.0]]), np.array([[0.5, 0.0, 0.0]]), np.zeros((1, 3))
    for _ in range(round(1.0 / CONTROL_DT)):
        clock[:, :2] = peer._advance(clock, walk, 1.0)
    np.testing.assert_allclose(np.cos(clock[0, :2]), [1.0, -1.0], atol=1e-9)
    clock[:, :2] = peer._advance(clock, still, 1.0)
    clock[:, 2] = 1.0
    np.testing.assert_array_equal(clock[0, :2], [np.pi, np.pi])
    np.testing.assert_array_equal(peer._advance(clock, walk, 1.0)[0], [0.0, np.pi])


@needs_peer
@pytest.mark.parametrize("name", peer.PEERS)
def test_same_bits_alone_and_in_a_batch(name: str) -> None:
    policy = peer.load_policy(name)
    velocity = np.random.default_rng(1).uniform(-1, 1, (4, 3))
    together = peer.PeerController(4, policy)
    alone = [peer.PeerController(1, policy) for _ in range(4)]
    for controller, worlds in [(together, np.arange(4)), *((one, np.array([0])) for one in alone)]:
        controller.reset(worlds, _sensed(4, 2)[: len(worlds)])
    together.velocity = velocity
    commands = np.tile(command.rest(), (4, 1))
    targets, single = np.zeros((4, 29)), np.zeros((4, 29))
    for tick in range(4):
        sensed = _sensed(4, 3 + tick)
        targets = together.step(sensed, commands)
        for world, controller in enumerate(alone):
            controller.velocity = velocity[[world]]
            single[world] = controller.step(sensed[np.array([world])], commands[[world]])[0]
    np.testing.assert_array_equal(targets, single)
    before = together.state.copy()
    some = np.array([2, 0])
    together.step(_sensed(4, 9)[some], commands[some], some)
    np.testing.assert_array_equal(together.state[[1, 3]], before[[1, 3]])
    assert (together.state[some] != before[some]).any(axis=1).all()


@needs_peer
def test_it_walks_as_told_with_its_own_gains_and_pose() -> None:
    policy = peer.load_policy("holosoma")
    simulation = peer.PeerSimulation(2, policy)
    for joint, stiffness in zip(g1.BODY_JOINTS, policy.stiffness, strict=True):
        assert simulation.model.actuator(joint).gainprm[0] == pytest.approx(stiffness)
    np.testing.assert_allclose(simulation.joint_positions, np.tile(policy.default, (2, 1)))
    soles = [simulation.pose(f"{side}_sole")[:, 2, 3] for side in g1.SIDES]
    np.testing.assert_allclose(np.min(soles, axis=0), 0.0, atol=1e-9)
    commands = np.tile(command.rest(), (2, 1))
    commands[1, 0] = 0.9  # beyond our own bound, within the peer's
    for _ in range(50):
        simulation.step(commands)
        assert not simulation.fallen().any()
    moved = np.linalg.norm(
        simulation.pose("pelvis")[:, :2, 3] - [simulation.task.default_state()["robot"][:2]] * 2, axis=1
    )
    assert moved[0] < 0.15
    assert moved[1] > 1.5
    np.testing.assert_array_equal(simulation.controller.velocity[1], [0.9, 0.0, 0.0])


@needs_peer
def test_its_summary_has_our_keys_and_leaves_out_what_it_is_not_asked() -> None:
    small = {"num_worlds": 1, "seconds": 8.0, "seed": 1, "num_threads": 1}
    found = json.loads(json.dumps(peer.benchmark("holosoma", **small, largest_hand_load=0.0, own_range=True)))
    assert set(found) >= set(benchmark.benchmark(**small))
    assert all(found[name] is None for name in peer.NOT_COMMANDED)
    assert 0.0 < found["linear_velocity_error"] < 1.0
    assert found["survival"] == 1.0
    assert found["peer"] == "holosoma, in its own range"
    assert (
        found["commanded"]
        == found["trained_for"]
        == {axis: [-1.0, 1.0] for axis in ("forward", "sideways", "yaw_rate")}
    )
