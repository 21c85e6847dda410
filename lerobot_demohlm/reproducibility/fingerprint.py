"""Snapshots of one world, step by step -> short fingerprints that name where two runs part, and one digest of it all.

A fingerprint is 4 bytes for each step and field, small enough to keep for every step; the digest is a full SHA-256 over
the same bytes, so that equal digests mean equal runs.
"""

import hashlib
from collections.abc import Mapping

import numpy as np

FIELDS = ("action", "physics", "controller", "contacts")
"""What is fingerprinted at every step: the action as stored; positions, velocities and whatever else moves; what the
whole-body controller and the neck remember; forces between hands and objects, and of collisions."""

_FIELD_OF = {
    "controller": "controller",
    "command": "controller",
    "neck": "controller",
    "forces": "contacts",
    "collisions": "contacts",
}  # of a snapshot's entries; every other one is physics
_SIZE = 4  # bytes of a fingerprint


class Trail:
    """The fingerprints of one world from its first step on; row t is the state that action t made, row 0 the start."""

    def __init__(self) -> None:
        self._digest = hashlib.sha256()
        self._rows: list[np.ndarray] = []

    def add(self, snapshot: Mapping[str, np.ndarray], world: int, action: np.ndarray | None = None) -> np.ndarray:
        """Take in one step and return its fingerprints, (4,) uint32 in the order of ``FIELDS``.

        Args:
            snapshot: Of a simulation, one row a world.
            world: Which row.
            action: (23,) float32 that led there; None at the start.
        """
        hashes = {field: hashlib.blake2b(digest_size=_SIZE) for field in FIELDS}
        content = {"action": b"" if action is None else action.tobytes()}
        content |= {name: values[world].tobytes() for name, values in snapshot.items()}
        for name in sorted(content):
            hashes["action" if name == "action" else _FIELD_OF.get(name, "physics")].update(content[name])
            self._digest.update(content[name])
        row = np.frombuffer(b"".join(hashes[field].digest() for field in FIELDS), dtype="<u4")
        self._rows.append(row)
        return row

    @property
    def rows(self) -> np.ndarray:
        """(steps + 1, 4) uint32."""
        return np.array(self._rows, dtype="<u4").reshape(-1, len(FIELDS))

    @property
    def digest(self) -> str:
        """SHA-256 of everything taken in so far, in hexadecimal."""
        return self._digest.hexdigest()


def from_bytes(content: bytes) -> np.ndarray:
    """Return the rows (steps + 1, 4) that ``Trail.rows.tobytes()`` wrote."""
    return np.frombuffer(content, dtype="<u4").reshape(-1, len(FIELDS))
