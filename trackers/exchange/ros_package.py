"""The optional package rosbags, which reads and writes bags of ROS 1 and ROS 2 without ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
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


def limit_unpacking(what: str) -> None:
    """Let rosbags, which sets no limit, unpack at most `LARGEST` bytes of a chunk, a message or the files of a bag."""
    names = "rosbag2.storage_mcap", "rosbag2.reader", "rosbag1.reader"
    mcap, folder, bag = (rosbags_module(name, what) for name in names)
    import bz2

    from lz4.frame import LZ4FrameDecompressor

    zstd = _LimitedZstd(mcap.zstd)
    vars(folder)["zstd"] = zstd
    mcap.DECOMPRESSORS.update(
        lz4=lambda data, _: unpacked_chunk(LZ4FrameDecompressor, data),
        zstd=lambda data, _: zstd.decompress(data),
    )
    bag.decompressors.update(
        bz2=lambda data: unpacked_chunk(bz2.BZ2Decompressor, data),
        lz4=lambda data: unpacked_chunk(LZ4FrameDecompressor, data),
    )


def unpacked_chunk(decompressor: Callable[[], Any], data: bytes) -> bytes:
    """The streams of a chunk or message unpacked; raises ValueError where one ends early or beyond `LARGEST` bytes."""
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


class _LimitedZstd:
    """What rosbags uses of the module zstd, for one bag; raises ValueError beyond `LARGEST` bytes."""

    def __init__(self, zstd: Any):
        self.zstd, self.left = zstd, LARGEST

    def decompress(self, data: bytes) -> bytes:
        return unpacked_chunk(self.zstd.ZstdDecompressor, data)

    @contextmanager
    def open(self, packed: Any, mode: str) -> Iterator[_LimitedZstd]:
        with self.zstd.open(packed, mode) as self.file:
            yield self

    def read(self, size: int) -> bytes:
        data: bytes = self.file.read(size)
        self.left -= len(data)
        if self.left < 0:
            raise ValueError(f"its files hold more than {LARGEST / 1e9:.1f} GB unpacked; decompress them")
        return data
