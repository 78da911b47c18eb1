"""The checksum that rerun puts at the end of a file: XXH32, https://github.com/Cyan4973/xxHash (format description)."""

from __future__ import annotations

import struct

_MASK = 0xFFFFFFFF
_P1, _P2, _P3, _P4, _P5 = 2654435761, 2246822519, 3266489917, 668265263, 374761393
_STRIPE = 16


def xxh32(data: bytes, seed: int = 0) -> int:
    """Return the XXH32 of ``data``."""
    stripes = len(data) // _STRIPE * _STRIPE
    value = _stripes(data[:stripes], seed) if stripes else (seed + _P5) & _MASK
    value = (value + len(data)) & _MASK
    words = stripes + (len(data) - stripes) // 4 * 4
    for (word,) in struct.iter_unpack("<I", data[stripes:words]):
        value = _rotated((value + word * _P3) & _MASK, 17) * _P4 & _MASK
    for byte in data[words:]:
        value = _rotated((value + byte * _P5) & _MASK, 11) * _P1 & _MASK
    value = (value ^ value >> 15) * _P2 & _MASK
    value = (value ^ value >> 13) * _P3 & _MASK
    return value ^ value >> 16


def _stripes(data: bytes, seed: int) -> int:
    a, b, c, d = (seed + _P1 + _P2) & _MASK, (seed + _P2) & _MASK, seed, (seed - _P1) & _MASK
    # Written out because this loop is all the time that it takes.
    for w, x, y, z in struct.iter_unpack("<4I", data):
        a = (a + w * _P2) & _MASK
        a = ((a << 13 | a >> 19) & _MASK) * _P1 & _MASK
        b = (b + x * _P2) & _MASK
        b = ((b << 13 | b >> 19) & _MASK) * _P1 & _MASK
        c = (c + y * _P2) & _MASK
        c = ((c << 13 | c >> 19) & _MASK) * _P1 & _MASK
        d = (d + z * _P2) & _MASK
        d = ((d << 13 | d >> 19) & _MASK) * _P1 & _MASK
    return (_rotated(a, 1) + _rotated(b, 7) + _rotated(c, 12) + _rotated(d, 18)) & _MASK


def _rotated(value: int, by: int) -> int:
    return (value << by | value >> (32 - by)) & _MASK
