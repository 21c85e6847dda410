"""One tick for training and running: the same sensors, observations, references and targets, bit for bit."""

import json
from pathlib import Path

import numpy as np
import pytest

from gym_demohlm.control import command, features
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.control.settings import UNTRIMMED, Gait, Settings
from gym_demohlm.control.whole_body import DEFAULT_WEIGHTS, WholeBodyController
from gym_demohlm.robot import g1
from gym_demohlm.wbc.training.mdp import MdpConfig, WholeBodyMdp
from tests.helpers.gaits import GAITS

_WORLDS = 12


class _Spied(WholeBodyController):
    """A controller that keeps what its policy saw."""

    seen: np.ndarray

    def _act(self, observed: np.ndarray) -> np.ndarray:
        self.seen = observed
        return super()._act(observed)


def _weights(path: Path, mdp: WholeBodyMdp, settings: Settings) -> Path:
    """Write the packaged policy with the tables of a training and other settings."""
    with np.load(DEFAULT_WEIGHTS) as file:
        arrays = dict(file)
    metadata = json.loads(arrays["metadata"].tobytes()) | settings.metadata()
    arrays["metadata"] = np.frombuffer(json.dumps(metadata).encode(), dtype=np.uint8)
    arrays["posture_table"], arrays["arm_table"] = mdp.reference.posture_table, mdp.reference.arm_load.table
    np.savez(path, allow_pickle=False, **arrays)
    return path


@pytest.mark.parametrize("gait", GAITS.values(), ids=GAITS.keys())
def test_training_and_running_share_the_tick(tmp_path: Path, gait: Gait) -> None:
    mdp = WholeBodyMdp(MdpConfig(num_worlds=_WORLDS, num_variants=4, gait=gait, push_every=(50, 80)))
    mdp.level = mdp.push_level = 1.0
    mdp.reset(np.arange(_WORLDS))
    controller = _Spied(_WORLDS, _weights(tmp_path / "w.npz", mdp, Settings(gait=gait, trim=UNTRIMMED)))
    assert controller.settings == mdp.settings
    body, arms = features.OBSERVED_INDEX, command.ARMS.start + features.OBSERVED_ARM_INDEX
    walked = 0
    for _ in range(200):
        sensors = mdp.sensors()
        q, dq = np.zeros((2, _WORLDS, len(g1.BODY_JOINTS)))
        q[:, body], dq[:, body] = sensors.q, sensors.dq
        commands = np.zeros((_WORLDS, command.SIZE))
        commands[:, : command.ARMS.start], commands[:, arms] = mdp.commands.goal, mdp.commands.arms
        controller.state = mdp.memory.copy()
        sensed = Proprioception(quat_wxyz=sensors.quat_wxyz, gyro=sensors.gyro, q=q, dq=dq)
        targets = controller.step(sensed, commands)
        now, action = mdp.now, controller.last_action
        assert np.array_equal(now.observation(), controller.seen)
        attitude_now = sensors.attitude()
        pose = controller.reference(now.told, now.clock, now.velocity, now.arms, now.carried, attitude_now)
        shared = mdp.reference(now.told, now.clock, now.velocity, now.arms, now.carried, now.attitude)
        assert np.array_equal(pose, shared)
        _, _, ended = mdp.step(action)
        assert np.array_equal(mdp.targets, targets[:, body])
        assert np.array_equal(mdp.memory, controller.state)
        walked += int((~mdp.now.clock.standing).sum())
        mdp.reset(np.nonzero(ended)[0])
    assert 200 < walked < 200 * _WORLDS  # some stood and some walked


def test_the_policy_sees_the_clock_that_moves_its_legs() -> None:
    """What training observed one tick before what it moved was observed in the same tick at run time."""
    mdp = WholeBodyMdp(MdpConfig(num_worlds=_WORLDS, num_variants=2))
    for _ in range(30):
        seen, _ = mdp.observe()
        phase, standing = mdp.now.clock.phase, mdp.now.clock.standing
        clock = seen[:, features.ODOMETRY.start - 3 : features.ODOMETRY.start]
        np.testing.assert_allclose(clock[:, 0], np.where(standing, 0.0, np.sin(2 * np.pi * phase)), atol=1e-6)
        before = mdp.memory.copy()
        mdp.step(np.zeros((_WORLDS, features.ACTION_SIZE)))
        assert not np.array_equal(before, mdp.memory)
