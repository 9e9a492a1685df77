"""Content of files: bytes, arrays and TOML by a schema in; atomic writes, and strict JSON without NaN, out."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import re
import reprlib
import shutil
import tomllib
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import polars as pl
from pydantic import BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core import to_json

from trackwright.trackers.core.errors import UnusableInput

T = TypeVar("T")
Content = pl.DataFrame | str | bytes

PREFIX = ".trackwright-"  # of temporary files
LARGEST = 2**31  # bytes of the largest file that is read: some 50 million rows of a table
LARGEST_NUMBER = 1e9  # largest in a file of geometry: squares of squares stay finite


def file_bytes(path: Path, most: int = -1) -> bytes:
    """The content of a file, or its first `most` bytes; raises OSError for pipes and devices, and beyond `LARGEST`."""
    status = path.stat()
    if not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "is a pipe or device, not a file", path)
    if most < 0 and status.st_size > LARGEST:
        raise OSError(errno.EFBIG, f"holds more than {LARGEST / 1e9:.1f} GB; split it", path)
    with path.open("rb") as file:
        return file.read(most)


def identity(path: Path) -> dict[str, str]:
    """Name and fingerprint of a small file: what tells it from others."""
    return {"name": path.name, "fingerprint": hashlib.sha256(path.read_bytes()).hexdigest()[:16]}


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an `.npz` file by name; raises ValueError for other content."""
    try:
        with np.load(io.BytesIO(file_bytes(path)), allow_pickle=False) as file:
            return dict(file)
    except Exception as error:  # Damaged data raise errors of many kinds.
        raise ValueError(str(error)) from error


def read_toml(path: Path, expected: str) -> dict[str, Any]:
    """The content of a TOML file in UTF-8; raises UnusableInput, which names what was `expected`."""
    try:
        return tomllib.loads(file_bytes(path).decode("utf-8-sig"))
    except OSError as error:
        raise UnusableInput(f"{path}: cannot be read ({error.strerror}); expected {expected}") from error
    except (ValueError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error).splitlines()[0]
        fix = "save it as UTF-8, give each key once, write texts in quotes and lists in brackets"
        raise UnusableInput(f"{path}: is not valid TOML: {reason}; expected {expected}; {fix}") from error


AS_FILE = ConfigDict(extra="forbid", arbitrary_types_allowed=True)  # of a dataclass whose fields are the keys of a file

Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
Positive = Annotated[Number, Field(gt=0.0)]
Count = Annotated[int, Field(strict=True, ge=0)]  # numbers of a file: finite, and of at most `LARGEST_NUMBER` in size


def _numbers(value: Any) -> Any:
    if not isinstance(value, list):
        return value
    array = np.array(value)
    if array.dtype.kind not in "if" or not (np.abs(array) <= LARGEST_NUMBER).all():
        raise ValueError(f"= {reprlib.repr(value)}, expected finite numbers, at most {LARGEST_NUMBER:g} in size")
    return array.astype(float)


NUMBERS = BeforeValidator(_numbers)  # turns lists of a file into an array, of a dataclass's field


def read_model(path: Path, model: type[T], expected: str, fix: str = "", version: int | None = None) -> T:
    """The content of a TOML file by a schema, of `format` = `version`; raises UnusableInput with the key."""
    content, fix = read_toml(path, expected), fix or f"{path.name} has {expected}"
    if version is not None and (given := content.pop("format", None)) is not version:
        found = "no format" if given is None else f"format = {given!r}"
        raise UnusableInput(f"{path}: {found}, expected {expected}; {fix}")
    try:
        return TypeAdapter(model).validate_python(content)
    except ValidationError as problem:
        error = problem.errors(include_url=False)[0]
    unknown = error["type"] == "literal_error" and "[key]" in error["loc"]
    parts = (f" {part + 1}" if isinstance(part, int) else f".{part}" for part in error["loc"] if part != "[key]")
    place = "".join(parts).removeprefix(".")
    value = error["input"].tolist() if isinstance(error["input"], np.ndarray) else error["input"]
    if error["type"] == "missing":
        words = "is missing"
    elif error["type"] in ("unexpected_keyword_argument", "extra_forbidden") or unknown:
        words = "is no key of it"
    elif "error" in error.get("ctx", {}):
        words = str(error["ctx"]["error"])
    else:
        said = error["msg"].replace("Input should be ", "").replace("a valid dictionary", "a table")
        said = re.sub(r"\w+ should have (.*) after validation.*", r"\1", said)
        said = re.sub(r".*Float\[ndarray, '(.*)'\].*", r"numbers of shape \1", said).replace("  ", " ")
        words = f"= {reprlib.repr(value)}, expected {said}"
    separator = " " if words.startswith(("=", "is ")) else ": "
    raise UnusableInput(f"{path}{': ' * bool(place)}{place}{separator}{words}; {fix}")


def atomic_write(path: Path | str, writer: Callable[[Path], object]) -> Path:
    """Has `writer` write a file beside `path` that becomes it when whole; raises UnusableInput where it cannot."""
    path = Path(path)
    try:
        with beside(path) as temporary:
            writer(temporary)
            os.replace(temporary, path)
    except (OSError, pl.exceptions.PolarsError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        fix = "expected a folder with space that may be written to; choose another folder"
        raise UnusableInput(f"cannot write {path}: {reason}; {fix}") from error
    return path


def write_whole(path: Path, content: Content) -> Path:
    """Writes a table, a text or bytes, and its folder; returns the path. Raises UnusableInput as `atomic_write`."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnusableInput(f"{path.parent}: cannot be created ({error.strerror}); choose another --out") from error
    if isinstance(content, pl.DataFrame):
        return atomic_write(path, lambda temporary: content.write_parquet(temporary, compression_level=1))
    data = content.encode() if isinstance(content, str) else content
    return atomic_write(path, lambda temporary: temporary.write_bytes(data))


def json_text(value: Any) -> str:
    """The value as indented JSON: NumPy numbers as numbers, arrays as lists, NaN and infinity as null."""
    return to_json(value, indent=2, inf_nan_mode="null", fallback=_plain).decode() + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    return np.asarray(value).tolist() if hasattr(value, "__array__") else str(value)


def config_hash(config: Mapping[str, Any]) -> str:
    """The SHA-256 of a configuration, independent of the order of its keys."""
    canonical = json.dumps(json.loads(json_text(config)), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


@contextmanager
def beside(path: Path, make: Callable[[Path], object] = Path.touch) -> Iterator[Path]:
    """A new file (`Path.mkdir`: folder) beside `path`, to be renamed to it within the block, and removed otherwise."""
    temporary = path.with_name(f"{PREFIX}{uuid.uuid4().hex[:8]}-{path.name}")
    try:
        make(temporary)
        yield temporary
    finally:
        with suppress(OSError):
            shutil.rmtree(temporary) if temporary.is_dir() else temporary.unlink(missing_ok=True)
