"""A process that must be on time -> real-time priority and memory that stays, where the system allows them.

Nor does it collect garbage.

Threads inherit the priority, so a process asks for it before it opens the network.
"""

import ctypes
import gc
import os
from contextlib import suppress

CONTROL, HELPERS = 20, 10
"""Of SCHED_FIFO: of what writes commands and of a simulated robot; of policy, pose source and servos."""
_ALL_THAT_IS_USED = 1 | 2 | 4  # MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT of mlockall(2): what is not touched takes no room


def hurry(priority: int) -> bool:
    """Ask not to be kept waiting; returns whether the system allows the priority.

    Pages of memory that the system takes back meanwhile would have to be fetched again, which takes up to 100 ms.

    Args:
        priority: Of SCHED_FIFO, from 1.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    ctypes.CDLL(None).mlockall(_ALL_THAT_IS_USED)  # refused to users without the right; then pages may go
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        return True
    return False
