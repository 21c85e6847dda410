"""32-bit words -> the checksum that the G1 expects at the end of its messages (CRC-32/MPEG-2, most significant first).

The SDK of the robot computes it bit by bit. zlib's CRC-32 has the same polynomial with all bits in reverse order, so
bytes are reversed before it and its result after it: 9 us for a command instead of 2 ms.
"""

import zlib

import numpy as np

_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
_ONES = 0xFFFFFFFF


def crc_of_words(words: np.ndarray) -> int:
    """Return the checksum of words (n,), an unsigned number of 32 bits.

    Args:
        words: (n,) of 32 bits, in the order of the message's C struct.
    """
    reflected = zlib.crc32(words.astype(">u4").tobytes().translate(_REVERSED)) ^ _ONES
    return int.from_bytes(reflected.to_bytes(4, "little").translate(_REVERSED), "big")
