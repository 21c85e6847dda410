"""DDS domains, each for one test of this machine."""

import os
import socket

DOMAINS = range(20, 180)  # behind them are those of the benchmarks
_held: list[socket.socket] = []


def free_domain() -> int:
    """Return a DDS domain that no other test of this machine gets, until this process ends in any way.

    Abstract socket names are held in it: like ``lo``, they are of one network, and the system frees them.

    Raises:
        AssertionError: All are held.
    """
    start = 17 * os.getpid()  # a run that was killed may have left a robot in the first of its domains
    for step in range(len(DOMAINS)):
        domain = DOMAINS[(start + step) % len(DOMAINS)]
        name = socket.socket(socket.AF_UNIX)
        try:
            name.bind(f"\0demohlm-test-domain-{domain}")
        except OSError:
            name.close()
            continue
        _held.append(name)
        return domain
    raise AssertionError(f"no DDS domain of {DOMAINS} is free")
