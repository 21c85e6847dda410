"""One tick for training and running: the same sensors, observations, references and targets, bit for bit."""

import numpy as np
import pytest

from gym_demohlm.control import features, reference
from gym_demohlm.control.settings import UNTRIMMED, Gait, Settings
from gym_demohlm.control.tick import Tick
from gym_demohlm.control.whole_body import WholeBodyController
from gym_demohlm.robot import g1
from gym_demohlm.wbc.mdp import MdpConfig, WholeBodyMdp

_WORLDS = 12
_GAITS = {
    "first": Gait(),
    "every part of it": Gait(
        spread=0.08,
        swing_upright=0.6,
        ankle_upright=0.5,
        ankle_damping_s=0.05,
        turn=tuple(0.01 * np.arange(12)),
        capture=(0.095, 0.085, 0.135),
    ),
}


class _Spied(WholeBodyController):
    """A controller that keeps what its policy saw, and what the reference gave."""

    seen: np.ndarray
    pose: np.ndarray

    def _act(self, observed: np.ndarray) -> np.ndarray:
        self.seen = observed
        return super()._act(observed)


@pytest.mark.parametrize("gait", _GAITS.values(), ids=_GAITS.keys())
def test_training_and_running_share_the_tick(gait: Gait) -> None:
    mdp = WholeBodyMdp(MdpConfig(num_worlds=_WORLDS, num_variants=4, gait=gait, push_every=(50, 80)))
    mdp.level = mdp.push_level = 1.0
    mdp.reset(np.arange(_WORLDS))
    controller = _Spied(_WORLDS)
    controller.settings = Settings(gait=gait, trim=UNTRIMMED)
    body = features.OBSERVED_INDEX
    arms = reference.NUM_LOWER + features.OBSERVED_ARM_INDEX
    walked = 0
    for _ in range(200):
        sensors = mdp.sensors()
        q, dq = np.zeros((2, _WORLDS, len(g1.BODY_JOINTS)))
        q[:, body], dq[:, body] = sensors.q, sensors.dq
        commands = np.zeros((_WORLDS, 23))
        commands[:, :7] = mdp.commands.goal
        commands[:, 7 + arms - reference.NUM_LOWER] = mdp.commands.arms
        controller.state = mdp.memory.copy()
        targets = controller.step(sensors.quat_wxyz, sensors.gyro, q, dq, commands)
        action = controller.state[:, features.HISTORY * features.FRAME_SIZE :][:, : features.ACTION_SIZE]
        assert np.array_equal(mdp.now.observation(), controller.seen)
        assert np.array_equal(_aims(mdp, 0 * action), _aims_of(controller, mdp))
        _, _, ended = mdp.step(action)
        assert np.array_equal(mdp._targets, targets[:, body])
        assert np.array_equal(mdp.memory, controller.state)
        walked += int((~mdp.now.clock.standing).sum())
        mdp.reset(np.nonzero(ended)[0])
    assert 200 < walked < 200 * _WORLDS  # some stood and some walked


def _aims(mdp: WholeBodyMdp, action: np.ndarray) -> np.ndarray:
    """Return what training would aim at with an action, legs and waist."""
    return mdp._tick.targets(mdp.now, action)


def _aims_of(controller: WholeBodyController, mdp: WholeBodyMdp) -> np.ndarray:
    """Return what the running controller aims at in the same situation without its policy: the reference."""
    return Tick(controller.reference, controller.settings).targets(mdp.now, np.zeros((_WORLDS, features.ACTION_SIZE)))


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
