"""A process that must be on time -> its priority and memory that stays, where the system allows them.

Control, servos and a simulated robot have real-time priority: they sleep most of the time. Policy and pose source need
much of a core, so they only go before other programs. Where real-time processes leave a core less than 5 % of a second,
Linux stops them all for the rest of it (``sched_rt_runtime_us``): 50 ms without commands, in which a robot damps.

Threads that start later inherit the priority, so control and a simulated robot ask for it before they open the network.
"""

import ctypes
import gc
import os
from contextlib import suppress
from enum import Enum

_ALL_THAT_IS_USED = 1 | 2 | 4  # MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT of mlockall(2): what is not touched takes no room


class Urgency(Enum):
    """Who goes before whom."""

    CONTROL = 20
    """Priority of SCHED_FIFO: of what writes commands, to motors or servos, and of a simulated robot."""
    HELPER = -15
    """Niceness, not in real time: of policy and pose source."""


def hurry(urgency: Urgency) -> bool:
    """Ask not to be kept waiting; returns whether the system allows it.

    Nor does the process collect garbage from now on. Its pages of memory stay: to fetch one again that the system took
    back takes up to 100 ms.

    Args:
        urgency: Of the process.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    ctypes.CDLL(None).mlockall(_ALL_THAT_IS_USED)  # refused to users without the right; then pages may go
    with suppress(OSError):
        if urgency is Urgency.CONTROL:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(urgency.value))
        else:
            os.setpriority(os.PRIO_PROCESS, 0, urgency.value)
        return True
    return False
