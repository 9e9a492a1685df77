"""Content of input files within limits of size: whole files, unpacked gzip data, TOML, arrays."""

from __future__ import annotations

import errno
import gzip
import io
import os
import re
import stat
import tomllib
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from trackwright.trackers.core.errors import UnusableInput

LARGEST = 2**31
"""Bytes of the largest file that is read, packed or unpacked: some 50 million rows of a table."""
_PIECE = 2**20
_NO_ARRAYS = (OSError, ValueError, KeyError, EOFError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error)


def file_bytes(path: Path) -> bytes:
    """The content of a regular file.

    Raises OSError for a file that cannot be read, for a pipe or a device, which may have no end, and beyond `LARGEST`.
    """
    with open(path, "rb", opener=_opened) as file:
        return file.read()


def beginning(path: Path, size: int) -> bytes:
    """The first `size` bytes of a file; raises OSError as `file_bytes`."""
    with open(path, "rb", opener=_opened) as file:
        return file.read(size)


def _opened(path: str, flags: int) -> int:
    """Opens a regular file alone: opening a pipe would wait for a writer."""
    if size_of(path) > LARGEST:
        raise too_large(Path(path))
    return os.open(path, flags)


def size_of(path: Path | str) -> int:
    """The bytes of a regular file; raises OSError for anything else."""
    found = os.stat(path)
    if stat.S_ISDIR(found.st_mode):
        raise OSError(errno.EISDIR, "is a folder, not a file", path)
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "is a pipe or device, not a file", path)
    return found.st_size


def too_large(path: Path) -> OSError:
    """The refusal of a file beyond `LARGEST`."""
    return OSError(errno.EFBIG, f"holds more than {LARGEST / 1e9:.1f} GB; split it", str(path))


def unpacked(path: Path, data: bytes) -> bytes:
    """Gzip data unpacked; raises OSError beyond `LARGEST`, before more is unpacked, and as `gzip` for broken data."""
    pieces, size = [], 0
    with gzip.GzipFile(fileobj=io.BytesIO(data)) as packed:
        while piece := packed.read(_PIECE):
            pieces.append(piece)
            size += len(piece)
            if size > LARGEST:
                raise too_large(path)
    return b"".join(pieces)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an `.npz` file by name; raises ValueError for other content, and beyond `LARGEST` unpacked."""
    try:
        with open(path, "rb", opener=_opened) as raw, zipfile.ZipFile(raw) as file:
            if sum(member.file_size for member in file.infolist()) > LARGEST:
                raise too_large(path)
            return {
                name.removesuffix(".npy"): np.lib.format.read_array(io.BytesIO(file.read(name)), allow_pickle=False)
                for name in file.namelist()
            }
    except _NO_ARRAYS as error:
        raise ValueError(str(error)) from error


def read_toml(path: Path, expected: str) -> dict[str, Any]:
    """The content of a TOML file in UTF-8; raises UnusableInput, which names what was `expected`."""
    text = ""
    try:
        text = file_bytes(path).decode("utf-8-sig")
        return tomllib.loads(text)
    except OSError as error:
        raise UnusableInput(f"{path}: cannot be read ({error.strerror}); expected {expected}") from error
    except UnicodeDecodeError as error:
        raise UnusableInput(
            f"{path}: is not valid TOML: is not UTF-8 text at byte {error.start}; expected {expected}; save it as UTF-8"
        ) from error
    except (ValueError, RecursionError) as error:
        # Numbers of thousands of digits raise ValueError, thousands of brackets RecursionError.
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error).splitlines()[0]
        twice = _given_twice(text, reason)
        if twice:
            raise UnusableInput(f"{path}: {twice}; expected it once; remove one") from error
        raise UnusableInput(
            f"{path}: is not valid TOML: {reason}; expected {expected}; write texts in quotes and lists in brackets"
        ) from error


def _given_twice(text: str, reason: str) -> str:
    """The key that a TOML file has twice, in words, by the parser's `reason`; empty for another one."""
    at = re.search(r"(?:overwrite|twice).*\(at (?:line (\d+)|end of document)", reason)
    if at is None:
        return ""
    lines = text.rstrip().splitlines()
    number = int(at[1] or len(lines))
    key = lines[number - 1].partition("=")[0].strip(" \t[]")
    return f"line {number}: {key} is given twice"
