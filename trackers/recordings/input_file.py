"""Content of input files within limits of size: whole files, unpacked gzip data, arrays, TOML and its values."""

from __future__ import annotations

import errno
import gzip
import hashlib
import io
import math
import os
import re
import stat
import tomllib
import zipfile
import zlib
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np

from trackwright.trackers.core.errors import UnusableInput

T = TypeVar("T")

LARGEST = 2**31
"""Bytes of the largest file that is read, packed or unpacked: some 50 million rows of a table."""

LARGEST_NUMBER = 1e9
"""Size of the largest number in a file of geometry, beyond all coordinates on Earth; squares of squares stay finite."""

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


def identity(path: Path) -> dict[str, str]:
    """Name and fingerprint of a small file: what tells it from others."""
    return {"name": path.name, "fingerprint": hashlib.sha256(path.read_bytes()).hexdigest()[:16]}


def size_of(path: Path | str) -> int:
    """The bytes of a regular file; raises OSError for anything else."""
    status = os.stat(path)
    if stat.S_ISDIR(status.st_mode):
        raise OSError(errno.EISDIR, "is a folder, not a file", path)
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "is a pipe or device, not a file", path)
    return status.st_size


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


def read_model(path: Path, model: type[T], expected: str) -> T:
    """The content of a TOML file as a dataclass, whose fields are its schema; raises UnusableInput with the key.

    `expected`: the content in words.
    """
    # Few commands read such a file, and the import takes a tenth of a second.
    from pydantic import TypeAdapter, ValidationError

    content = read_toml(path, expected)
    try:
        return TypeAdapter(model).validate_python(content)
    except ValidationError as problem:
        error = problem.errors(include_url=False)[0]
    place = "".join(
        f" {part + 1}" if isinstance(part, int) else f".{part}" for part in error["loc"] if part != "[key]"
    )[1:]
    if "error" in error.get("ctx", {}):
        raise UnusableInput(f"{path}: {place + ': ' if place else ''}{error['ctx']['error']}")
    said = {"missing": "is missing", "unexpected_keyword_argument": "is no key of it"}
    expects = error["msg"].replace("Input should be", "expected").replace(" or an instance of", " as of")
    found = said.get(error["type"], f"= {repr(error['input'])[:60]}, {expects}")
    raise UnusableInput(f"{path}: {place} {found}; {path.name} has {expected}")


def _given_twice(text: str, reason: str) -> str:
    """The key that a TOML file has twice, in words, by the parser's `reason`; empty for another one."""
    at = re.search(r"(?:overwrite|twice).*\(at (?:line (\d+)|end of document)", reason)
    if at is None:
        return ""
    lines = text.rstrip().splitlines()
    number = int(at[1] or len(lines))
    key = lines[number - 1].partition("=")[0].strip(" \t[]")
    return f"line {number}: {key} is given twice"


class TomlReader:
    """The content of a TOML file, whose values are refused with their key where they are not what is expected.

    `content`: of the file. `fix`: the usual remedy, which ends each refusal. Raises UnusableInput as `read_toml`.
    """

    def __init__(self, path: Path, expected: str, fix: str = "") -> None:
        self.path, self.expected, self.fix = path, expected, fix
        self.content = read_toml(path, expected)

    def refuse(self, what: str, fix: str = "") -> NoReturn:
        """Raises UnusableInput."""
        raise UnusableInput("; ".join(text for text in (f"{self.path}: {what}", fix or self.fix) if text))

    def wrong(self, where: str, value: Any, expected: str) -> NoReturn:
        """Raises UnusableInput for the value of a key."""
        shown = repr(value) if len(repr(value)) <= 60 else repr(value)[:57] + "..."
        self.refuse(f"{where} = {shown}, expected {expected}")

    def of_format(self, version: int) -> None:
        """Refuses a file whose `format` is another one."""
        given = self.content.get("format")
        if given != version or isinstance(given, bool):
            was = "no `format`" if given is None else f"format = {given!r}"
            self.refuse(f"{was}, expected `format = {version}` for {self.expected}", self.fix or "correct it")

    def table(self, where: str, value: Any) -> dict[str, Any]:
        """A value that is a table."""
        if not isinstance(value, dict):
            self.wrong(where, value, f"a table [{where}]")
        return value

    def number(self, where: str, value: Any) -> float:
        """A finite number of at most `LARGEST_NUMBER` in size."""
        return float(self.array(where, value, ()))

    def array(self, where: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
        """Lists of so many finite numbers, as an array."""
        if not _has_shape(value, shape):
            of = {0: "a finite number", 1: "a list of {} finite numbers", 2: "{} lists of {} finite numbers"}
            expected = of[len(shape)].format(*shape)
            self.wrong(where, value, f"{expected}, at most {LARGEST_NUMBER:g} in size")
        return np.array(value, float)


def _has_shape(value: Any, shape: tuple[int, ...]) -> bool:
    if shape:
        return isinstance(value, list) and len(value) == shape[0] and all(_has_shape(x, shape[1:]) for x in value)
    try:
        return not isinstance(value, bool | str) and math.isfinite(value) and abs(value) <= LARGEST_NUMBER
    except (TypeError, OverflowError):
        return False
