"""Random faults in the bytes of a file, and Parquet footers that claim what is not there."""

from __future__ import annotations

import gzip

from tests.faults.values import ENCODINGS, Draw, pick
from trackwright.trackers.recordings.table_file import MARK


def _flipped(draw: Draw, data: bytes) -> bytes:
    changed = bytearray(data)
    for at in draw.integers(len(changed), size=min(len(changed), int(pick(draw, (1, 1, 2, 8, 64))))) if changed else ():
        changed[at] = int(draw.integers(256))
    return bytes(changed)


def _cut(draw: Draw, data: bytes) -> bytes:
    return data[: int(draw.integers(len(data) + 1))]


def _spliced(draw: Draw, data: bytes) -> bytes:
    at = int(draw.integers(len(data) + 1))
    new = pick(
        draw, (b"\0" * 100, bytes(range(256)), b"\xff\xfe", b"\r", b"\x1f\x8b", b"PAR1", draw.bytes(64), data[:at])
    )
    return data[:at] + new + (data[at:] if draw.random() < 0.5 else data[at + len(new) :])


def _encoded(draw: Draw, data: bytes) -> bytes:
    return data.decode("latin-1").encode(pick(draw, ENCODINGS), "replace")


def _packed_again(draw: Draw, data: bytes) -> bytes:
    return gzip.compress(data, 1, mtime=0)


def _lying_footer(draw: Draw, data: bytes) -> bytes:
    """Other numbers in the footer of a Parquet file: counts and sizes of lists, texts and columns beyond all bounds."""
    if not data.endswith(MARK):
        return _flipped(draw, data)
    size = int.from_bytes(data[-8:-4], "little")
    footer = bytearray(data[-8 - size : -8])
    at = int(draw.integers(len(footer) + 1))
    claims = (
        b"\xff" * 9 + b"\x01",
        b"\xff\xff\xff\xff\x0f",
        b"\xfc\xff\xff\xff\xff\x0f",
        b"\x80" * 40,
        b"\x1c" * 4000,
        draw.bytes(16),
    )
    footer[at : at + int(draw.integers(3))] = pick(draw, claims)
    if draw.random() < 0.2:
        size = int(pick(draw, (2**32 - 1, 2**31, len(data), 0, 1)))
        return data[: len(data) - 8] + size.to_bytes(4, "little") + MARK
    return data[: -8 - size] + bytes(footer) + len(footer).to_bytes(4, "little") + MARK


OF_BYTES = (_flipped, _cut, _spliced, _encoded, _packed_again, _lying_footer)
