"""The state of a simulated world <-> the bytes of ``rt/demohlm/world``: what stands for eyes where no robot is real.

A pose source in another process restores the state in a world of its own and looks at it. A real robot sends nothing
of the kind.
"""

import struct

import numpy as np

from gym_demohlm.simulation import Simulation
from lerobot_demohlm.hardware.layout import HEADER

_HEAD = struct.Struct("<IIdII")  # bytes that follow, episode, time [s], numbers of physics, of mocap


def pack(episode: int, time_s: float, physics: np.ndarray, mocap: np.ndarray) -> bytes:
    """Return the bytes of a message.

    Args:
        episode: Number of the start.
        time_s: Of the world [s].
        physics: (n,) full physics state.
        mocap: (m,) mocap positions, then quaternions.
    """
    body = physics.astype("<f8").tobytes() + mocap.astype("<f8").tobytes()
    return HEADER + _HEAD.pack(len(body) + _HEAD.size - 4, episode, time_s, len(physics), len(mocap)) + body


def unpack(content: bytes) -> tuple[int, float, np.ndarray, np.ndarray]:
    """Return what ``pack`` was given.

    Raises:
        ValueError: Bytes of another size.
    """
    _, episode, time_s, num_physics, num_mocap = _HEAD.unpack_from(content, 4)
    numbers = np.frombuffer(content, "<f8", offset=4 + _HEAD.size)
    if len(numbers) != num_physics + num_mocap:
        raise ValueError(f"got {len(numbers)} numbers; expected {num_physics + num_mocap}; send the world again")
    return episode, time_s, numbers[:num_physics], numbers[num_physics:]


def show(sim: Simulation, physics: np.ndarray, mocap: np.ndarray) -> None:
    """Bring one world to a state.

    Args:
        sim: Of one world and the same task.
        physics: (n,).
        mocap: (m,).
    """
    snapshot = sim.snapshot()
    snapshot["physics"], snapshot["mocap"] = physics[None].copy(), mocap[None].copy()
    sim.restore(snapshot)
