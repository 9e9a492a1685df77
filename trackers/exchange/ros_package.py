"""The optional package rosbags, which reads and writes bags of ROS 1 and ROS 2 without ROS."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

from trackers.core.errors import UnusableInput
from trackers.recordings.input_file import LARGEST


def rosbags_module(name: str, what: str) -> ModuleType:
    """The module `rosbags.NAME`; raises UnusableInput, which names the extra, where the package is missing."""
    from importlib import import_module

    try:
        return import_module(f"rosbags.{name}")
    except ImportError:
        raise UnusableInput(
            f"{what} needs the package rosbags; install the extra: pip install 'trackwright[ros]'"
        ) from None


def limit_chunks(what: str) -> None:
    """Let rosbags unpack no chunk of a bag or MCAP file beyond `LARGEST` bytes; it sets no limit itself."""
    mcap, bag = (rosbags_module(name, what) for name in ("rosbag2.storage_mcap", "rosbag1.reader"))
    import bz2

    from lz4.frame import LZ4FrameDecompressor

    zstd = mcap.zstd.ZstdDecompressor
    mcap.DECOMPRESSORS.update(
        lz4=lambda data, _: unpacked_chunk(LZ4FrameDecompressor, data),
        zstd=lambda data, _: unpacked_chunk(zstd, data),
    )
    bag.decompressors.update(
        bz2=lambda data: unpacked_chunk(bz2.BZ2Decompressor, data),
        lz4=lambda data: unpacked_chunk(LZ4FrameDecompressor, data),
    )


def unpacked_chunk(decompressor: Callable[[], Any], data: bytes) -> bytes:
    """The streams of a chunk unpacked; raises ValueError where one ends early, and beyond `LARGEST` bytes."""
    parts, left = list[bytes](), LARGEST
    while data:
        stream = decompressor()
        parts.append(stream.decompress(data, left + 1))
        left -= len(parts[-1])
        if left < 0:
            raise ValueError(f"a chunk holds more than {LARGEST / 1e9:.1f} GB unpacked")
        if not stream.eof:
            raise ValueError("a chunk ends early")
        data = stream.unused_data
    return b"".join(parts)
