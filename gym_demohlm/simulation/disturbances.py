"""Conditions and time -> what disturbs a world while it runs: noise of what is sensed, pushes, servos that are late.

Nothing is remembered: noise is a function of the world's seed and the number of the controller's tick, so a world that
goes on from a snapshot, alone or among others, gets the same.
"""

from collections.abc import Iterable

import numpy as np

from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.robot import g1
from gym_demohlm.timing import CONTROL_DT, PHYSICS_DT
from gym_demohlm.variation import Conditions
from gym_demohlm.variation.conditions import SEED
from gym_demohlm.variation.factors import MOST_PUSHES

_JOINTS = len(g1.BODY_JOINTS)
_NEVER = np.iinfo(np.int64).max
_BIAS_TICK = 2**40  # of the generator's counter: no episode is so long


class Disturbances:
    """Disturbances of N worlds; none until a reset gives a world its conditions.

    Args:
        num_worlds: N.

    Attributes:
        delay_steps: (N,) physics steps by which the servos get their targets late.
    """

    def __init__(self, num_worlds: int) -> None:
        self.delay_steps = np.zeros(num_worlds, dtype=np.int64)
        self._seeds = np.zeros(num_worlds, dtype=np.int64)
        self._philox = np.random.Philox(key=0)
        self._generator, self._state = np.random.Generator(self._philox), self._philox.state
        self._noise = np.zeros((num_worlds, 4))  # of encoders [rad], speeds [rad/s], gyroscope [rad/s], gravity [rad]
        self._bias = np.zeros((num_worlds, _JOINTS))
        self._push_ticks = np.full((num_worlds, MOST_PUSHES), _NEVER)
        self._pushes = np.zeros((num_worlds, MOST_PUSHES, 2))

    def reset(self, world: int, conditions: Conditions) -> None:
        """Give a world other conditions."""
        number = conditions.number
        self._seeds[world] = int((conditions.values.get(SEED) or (0.0,))[0])
        self._noise[world] = [number(f"robot.{name}", plain=0.0) for name in ("encoder", "speed", "gyro", "gravity")]
        self.delay_steps[world] = round(number("robot.delay", plain=0.0) / PHYSICS_DT)
        bias = number("robot.encoder_bias", plain=0.0)
        self._bias[world] = bias * self._uniform([world], [_BIAS_TICK], _JOINTS)[0] if bias > 0.0 else 0.0
        pauses, velocities = conditions.numbers("pushes.pause"), conditions.numbers("pushes.velocity")
        self._push_ticks[world], self._pushes[world] = _NEVER, 0.0
        if pauses is not None and velocities is not None:
            self._push_ticks[world] = np.rint(np.cumsum(pauses) / CONTROL_DT)
            self._pushes[world] = np.reshape(velocities, (MOST_PUSHES, 2))

    def push(self, worlds: np.ndarray, ticks: np.ndarray) -> np.ndarray:
        """Return by how much the velocity of the pelvis changes now, (n, 2) along x and y of the world [m/s].

        Args:
            worlds: (n,) indices.
            ticks: (n,) of the controller since their resets.
        """
        due = self._push_ticks[worlds] == ticks[:, None]
        return (self._pushes[worlds] * due[..., None]).sum(axis=1)

    def sense(self, sensed: Proprioception, worlds: np.ndarray, ticks: np.ndarray) -> Proprioception:
        """Return what n robots sense where ``sensed`` is the truth; arguments as ``push``."""
        quat, gyro, q, dq = sensed.quat_wxyz.copy(), sensed.gyro.copy(), sensed.q.copy(), sensed.dq.copy()
        q += self._bias[worlds]
        noisy = self._noise[worlds].any(axis=1)
        if noisy.any():
            encoder, speed, turn, tilt = self._noise[worlds[noisy], :, None].swapaxes(0, 1)
            noise = self._uniform(worlds[noisy], ticks[noisy], 2 * _JOINTS + 5)
            q[noisy] += encoder * noise[:, :_JOINTS]
            dq[noisy] += speed * noise[:, _JOINTS : 2 * _JOINTS]
            gyro[noisy] += turn * noise[:, -5:-2]
            quat[noisy] = _tilted(quat[noisy], tilt * noise[:, -2:])
        return Proprioception(quat_wxyz=quat, gyro=gyro, q=q, dq=dq)

    def _uniform(self, worlds: Iterable[int], ticks: Iterable[int], count: int) -> np.ndarray:
        """Return numbers (n, count) from -1 to 1, a function of each world's seed and its tick."""
        drawn = []
        for world, tick in zip(worlds, ticks, strict=True):
            # One generator that is set anew: one for each world and tick would take twice the time.
            self._state["state"]["key"][0], self._state["state"]["counter"][3] = self._seeds[world], tick
            self._philox.state = self._state
            drawn.append(self._generator.random(count))
        return 2.0 * np.array(drawn) - 1.0


def _tilted(quat: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """Return orientations (n, 4) wxyz turned by small angles (n, 2) about their own x and y axes [rad]."""
    w, x, y, z = quat.T
    a, b = tilt.T / 2
    turned = np.stack([w - x * a - y * b, x + w * a - z * b, y + w * b + z * a, z + x * b - y * a], axis=1)
    return turned / np.sqrt((turned**2).sum(axis=1, keepdims=True))
