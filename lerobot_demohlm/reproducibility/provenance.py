"""Simulation -> what its results depend on: hashes of controller and compiled model, family of processors."""

import functools
import hashlib
import platform
from pathlib import Path

import mujoco
import numpy as np

import gym_demohlm
from gym_demohlm.control.whole_body import Weights

_VECTOR_UNITS = ("avx512f", "avx2", "sse4_2", "sve", "asimd")  # widest first


def controller_hash() -> str:
    """Return the SHA-256 of the shipped controller's weights."""
    return Weights().hash


def model_hash(model: mujoco.MjModel) -> str:
    """Return the SHA-256 of a compiled model."""
    buffer = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()


@functools.cache
def code_hash() -> str:
    """Return the SHA-256 of the code that simulates: ``gym_demohlm`` but for what trains the controller."""
    root, digest = Path(gym_demohlm.__file__).parent, hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root).as_posix()
        if not name.startswith("wbc/"):
            digest.update(f"{name} {path.stat().st_size} ".encode() + path.read_bytes())
    return digest.hexdigest()


@functools.cache
def cpu_family() -> str:
    """Return what of the processor decides the last bits of floating-point results: make and widest vector unit."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}".strip()
    entries: dict[str, str] = {}
    for line in lines:
        key, _, value = line.partition(":")
        entries.setdefault(key.strip(), value.strip())
    flags = entries.get("flags", entries.get("Features", "")).split()
    vector = next((unit for unit in _VECTOR_UNITS if unit in flags), "")
    return " ".join(part for part in (platform.machine(), entries.get("vendor_id", ""), vector) if part)
