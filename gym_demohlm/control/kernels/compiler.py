"""A function of numbers and arrays -> machine code, kept on disk from one process to the next.

The cache lies beside the source files, in the user's cache where these may not be written, or where NUMBA_CACHE_DIR
says. Where nothing may be written, every process compiles anew. Numba looks only at the file of the function itself
to see whether its code is still the same; here the name in the cache ends in a digest of all kernels, of
``arithmetic``, whose functions they call, and of the constants that are compiled into them, wherever those come from.
"""

import hashlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numba
import numpy as np

from gym_demohlm import arithmetic

_PACKAGE = __name__.rpartition(".")[0]


def digest(package: str = _PACKAGE) -> str:
    """Return letters that change with source and constants of ``arithmetic`` and of a package's imported modules."""
    found = hashlib.sha256()
    for name, module in sorted(sys.modules.items()):
        if (name.startswith(f"{package}.") or module is arithmetic) and module.__file__:
            found.update(Path(module.__file__).read_bytes())
            for key, value in sorted(vars(module).items()):
                if isinstance(value, int | float | tuple | np.ndarray) and not key.startswith("__"):
                    found.update(f"{key} {np.shape(value)}".encode() + np.asarray(value).tobytes())
    return found.hexdigest()[:12]


def compiled[F: Callable[..., Any]](function: F) -> F:
    """Compile a function when it is first called; a division by zero gives infinity, as in NumPy."""
    function.__qualname__ += f"_{digest()}"
    try:
        return cast(F, numba.njit(function, cache=True, error_model="numpy", nogil=True))
    except RuntimeError:  # no place for a cache
        return cast(F, numba.njit(function, error_model="numpy", nogil=True))


inlined = numba.njit(error_model="numpy")
"""Compiles what only kernels call, as a part of each of them."""
