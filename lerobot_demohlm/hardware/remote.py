"""The 40 bytes of the wireless remote in LowState <-> which buttons are pressed.

The layout is Unitree's (``xRockerBtnDataStruct``): two bytes, 16 bits of buttons, five floats of sticks, 16 bytes.
"""

import numpy as np

BUTTONS = (
    "R1", "L1", "start", "select", "R2", "L2", "F1", "F2", "A", "B", "X", "Y", "up", "right", "down", "left",
)  # fmt: skip
ESTOP = (frozenset({"L2", "B"}), frozenset({"select"}))
"""Any of these stops the robot: L2 + B is Unitree's own way to damping; select is for the thumb that is there."""


def buttons(remote: np.ndarray) -> int:
    """Return the bits of the buttons, of (40,) uint8."""
    return int(remote[2:4].copy().view("<u2")[0])


def pressed(bits: int) -> frozenset[str]:
    """Return the names of the buttons that are pressed."""
    return frozenset(name for index, name in enumerate(BUTTONS) if bits >> index & 1)


def press(remote: np.ndarray, names: frozenset[str]) -> None:
    """Have a remote (40,) uint8 press some buttons and no other, in place."""
    bits = sum(1 << BUTTONS.index(name) for name in names)
    remote[2:4] = np.frombuffer(bits.to_bytes(2, "little"), np.uint8)


def asks_to_stop(bits: int) -> bool:
    """Return whether the pressed buttons are an e-stop."""
    held = pressed(bits)
    return any(combination <= held for combination in ESTOP)
