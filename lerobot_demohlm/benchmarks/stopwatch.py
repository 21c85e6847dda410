"""Methods of objects -> the CPU seconds that this process spends in them, for benchmarks."""

import time
from collections import defaultdict
from typing import Any


class Stopwatch:
    """Adds up the CPU time of the methods it watches; what one of them calls counts for both, where both are watched.

    Attributes:
        seconds: CPU seconds by name.
    """

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)

    def watch(self, owner: Any, method: str, name: str) -> None:  # noqa: ANN401
        """Time the calls of a method of one object from now on, under a name."""
        original = getattr(owner, method)

        def timed(*arguments: Any, **keywords: Any) -> Any:  # noqa: ANN401
            began = time.process_time()
            try:
                return original(*arguments, **keywords)
            finally:
                self.seconds[name] += time.process_time() - began

        setattr(owner, method, timed)
