"""The only way of commands to the motors: what a controller wants goes through the safety filter, then out.

The writer of ``rt/lowcmd`` is made here and nowhere else, and nobody is handed it.
"""

import numpy as np

from lerobot_demohlm.hardware.layout import LowCmd
from lerobot_demohlm.hardware.link import LOW_CMD, Link
from lerobot_demohlm.hardware.safety import SafetyFilter, Wanted


class CommandWire:
    """Sends commands to the motors of one robot.

    Args:
        link: The network.
        safety: What every command goes through.
    """

    def __init__(self, link: Link, safety: SafetyFilter) -> None:
        self.safety = safety
        self.__writer = link._writer(LOW_CMD)

    def send(self, wanted: Wanted, q: np.ndarray, dq: np.ndarray, mode_machine: int) -> LowCmd:
        """Filter and send what a controller wants; see ``SafetyFilter``. Returns what was sent."""
        return self.__send(self.safety(wanted, q, dq, mode_machine))

    def damp(self, mode_machine: int) -> LowCmd:
        """Brake all motors; returns what was sent."""
        return self.__send(self.safety.damp(mode_machine))

    def __send(self, message: LowCmd) -> LowCmd:
        self.__writer.send(message.to_bytes())
        return message
