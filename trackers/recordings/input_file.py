"""Content of input files within limits of size: whole files, unpacked gzip data, arrays, TOML and its values."""

from __future__ import annotations

import difflib
import errno
import gzip
import hashlib
import io
import os
import re
import reprlib
import stat
import tomllib
import zipfile
import zlib
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError

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


AS_FILE = ConfigDict(extra="forbid", arbitrary_types_allowed=True)
"""Of a dataclass whose fields are the keys of a file."""

Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
Positive = Annotated[Number, Field(gt=0.0)]
Count = Annotated[int, Field(strict=True, ge=0)]
"""Numbers of a file: finite, and of at most `LARGEST_NUMBER` in size."""


def _numbers(value: Any) -> Any:
    if not isinstance(value, list):
        return value
    array = np.array(value)
    if array.dtype.kind not in "if" or not (np.abs(array) <= LARGEST_NUMBER).all():
        raise ValueError(f"= {reprlib.repr(value)}, expected finite numbers, at most {LARGEST_NUMBER:g} in size")
    return array.astype(float)


NUMBERS = BeforeValidator(_numbers)
"""Turns lists of a file into an array, of a dataclass's field."""


def read_model(path: Path, model: type[T], expected: str, fix: str = "", version: int | None = None) -> T:
    """The content of a TOML file as a pydantic model or a dataclass; raises UnusableInput with the key.

    `expected`: the content in words. `fix`: the usual remedy, which ends a refusal. `version`: the file's `format`.
    """
    content = read_toml(path, expected)
    if version is not None and (given := content.pop("format", None)) is not version:
        found = "no format" if given is None else f"format = {given!r}"
        raise UnusableInput(f"{path}: {found}, expected {expected}; {fix or 'correct it'}")
    try:
        return TypeAdapter(model).validate_python(content)
    except ValidationError as problem:
        error = problem.errors(include_url=False)[0]
    parts = (f" {part + 1}" if isinstance(part, int) else f".{part}" for part in error["loc"] if part != "[key]")
    place, kind, value = "".join(parts).removeprefix("."), error["type"], error["input"]
    ending = f"; {fix or f'{path.name} has {expected}'}"
    if "error" in error.get("ctx", {}):
        said = str(error["ctx"]["error"])
        raise UnusableInput(f"{path}: {place}{' ' if said.startswith('=') else ': ' * bool(place)}{said}{ending}")
    if kind == "missing":
        key = str(error["loc"][-1])
        others = difflib.get_close_matches(key, [str(other) for other in value], 1, 0.7)
        raise UnusableInput(f"{path}: {place} is missing{f', found {others[0]}' if others else ''}{ending}")
    unknown = kind in ("unexpected_keyword_argument", "extra_forbidden")
    expects = error["msg"].replace("Input should be", "expected").replace("a valid dictionary", "a table")
    expects = re.sub(r" or (an )?(instance|object) .*", "", expects)
    expects = re.sub(r"\w+ should have (.*) after validation.*", r"expected \1", expects)
    expects = re.sub(r"an instance of Float\[ndarray, '(.*)'\]", r"numbers of shape \1", expects)
    value = value.tolist() if isinstance(value, np.ndarray) else value
    raise UnusableInput(
        f"{path}: {place} {'is no key of it' if unknown else f'= {reprlib.repr(value)}, {expects}'}{ending}"
    )


def _given_twice(text: str, reason: str) -> str:
    """The key that a TOML file has twice, in words, by the parser's `reason`; empty for another one."""
    at = re.search(r"(?:overwrite|twice).*\(at (?:line (\d+)|end of document)", reason)
    if at is None:
        return ""
    lines = text.rstrip().splitlines()
    number = int(at[1] or len(lines))
    key = lines[number - 1].partition("=")[0].strip(" \t[]")
    return f"line {number}: {key} is given twice"
