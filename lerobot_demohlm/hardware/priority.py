"""A process that must be on time -> real-time priority where the system allows it, and no garbage collection.

Threads inherit the priority, so a process asks for it before it opens the network.
"""

import gc
import os
from contextlib import suppress

CONTROL, HELPERS = 20, 10
"""Of SCHED_FIFO: of what writes commands and of a simulated robot; of policy, pose source and servos."""


def hurry(priority: int) -> bool:
    """Ask not to be kept waiting; returns whether the system allows it.

    Args:
        priority: Of SCHED_FIFO, from 1.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        return True
    return False
