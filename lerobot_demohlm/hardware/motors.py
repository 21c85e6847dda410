"""The newest LowCmd -> what the servos of the model do: the PD loops in a simulated robot's motors."""

import time

import mujoco
import numpy as np

from lerobot_demohlm.hardware.layout import NUM_JOINTS, LowCmd
from lerobot_demohlm.hardware.limits import COMMAND_TIMEOUT_S, DAMPING


class Motors:
    """The PD loops in the motors, and the robot's own answer to silence.

    Args:
        timeout_s: Without a command for so long, it damps by itself [s].

    Attributes:
        command: The newest that was carried out; None before the first.
        damped: Whether it damps by itself.
    """

    def __init__(self, timeout_s: float = COMMAND_TIMEOUT_S) -> None:
        self._timeout_s = timeout_s
        self.command: LowCmd | None = None
        self._at = -np.inf
        self.damped = True

    def obey(self, message: LowCmd) -> None:
        """Carry out a command from now on."""
        self.command, self._at = message, time.monotonic()

    @property
    def silence_s(self) -> float:
        """Time since the last command [s]."""
        return time.monotonic() - self._at

    @property
    def held(self) -> bool:
        """Whether every joint is held somewhere."""
        return not self.damped and self.command is not None and bool((self.command.kp[:NUM_JOINTS] > 0.0).all())

    def drive(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Have the servos of the model do what the motors' PD does: kp (q* - q) + kd (dq* - dq) + tau."""
        self.damped = self.silence_s > self._timeout_s
        joints = slice(0, NUM_JOINTS)
        if self.damped or self.command is None:
            kp, kd, extra, target = 0.0, DAMPING, 0.0, 0.0
        else:
            told = self.command
            kp, kd, target = told.kp[joints], told.kd[joints], told.q[joints]
            extra = told.tau[joints] + told.kd[joints] * told.dq[joints]
        model.actuator_gainprm[joints, 0] = kp
        model.actuator_biasprm[joints, 0], model.actuator_biasprm[joints, 1] = extra, -np.asarray(kp)
        model.actuator_biasprm[joints, 2] = -np.asarray(kd)
        data.ctrl[joints] = target
