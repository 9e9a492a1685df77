"""The folder of a study: its identity, and one file per finished chunk, which names the identity's digest."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from trackwright.experiments.jobs.store import Store
from trackwright.experiments.monte_carlo.declaration import Study, TrackerConfig
from trackwright.experiments.monte_carlo.results import Results, Totals
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.atomic import config_hash, json_text, write_whole
from trackwright.trackers.recordings.input_file import file_bytes, read_arrays

IDENTITY, CHUNKS = "study.json", "chunks"
FORMAT = 3  # of the files of chunks; a folder with another format holds another study
Part = tuple[int, int]  # a chunk: the index of its condition, and its number among the chunks of that


def identity(study: Study) -> dict[str, Any]:
    """Everything that the numbers of a study depend on: declaration, source file, chunk size, jaxlib and device."""
    content = {
        "study": study.name,
        "format": FORMAT,
        "worlds": {k: {"make": _named(w.make), "numbers": dict(w.numbers)} for k, w in study.worlds.items()},
        "trackers": {k: _config(c) for k, c in study.trackers.items()},
        "grid": {k: list(v) for k, v in study.grid.items()},
        "seed": study.seed,
        "chunk": study.chunk,
        "measures": list(study.measures),
        "kept of a first chunk": sorted({f for f in study.metrics if f.startswith("bound") or f == "us_per_row"}),
        "file": _sha256(study.source) if study.source else None,
        "jaxlib": version("jaxlib"),
        "device": jax.devices()[0].device_kind,
    }
    plain: dict[str, Any] = json.loads(json_text(content))
    return plain


def digest_of(study: Study) -> str:
    """The digest of a study's identity."""
    return config_hash(identity(study))


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _named(function: Callable[..., Any]) -> str:
    inner = getattr(function, "func", function)
    return f"{getattr(inner, '__module__', '')}.{getattr(inner, '__qualname__', type(inner).__name__)}"


def _config(config: TrackerConfig) -> dict[str, Any]:
    name = config.tracker if isinstance(config.tracker, str) else config.tracker.about
    if isinstance(config.tracker, str) and (file := name.rpartition(":")[0]):
        name += f" {_sha256(Path(file).read_text('utf-8'))}"
    rest = {"smooth": config.smooth, "free_height": config.free_height, "every": config.every}
    return {"tracker": name, "tunables": dict(config.tunables), **rest}


def first_difference(other: Mapping[str, Any], mine: Mapping[str, Any]) -> str:
    """The first key in which two identities differ, and both values; empty for none."""
    for key in mine:
        if other.get(key) != mine[key]:
            return f"{key}: {str(other.get(key))[:60]}, not {str(mine[key])[:60]}"
    return ""


@dataclass(frozen=True)
class ChunkStore(Store[Part, bytes]):
    """The folder with the finished chunks of a study."""

    folder: Path
    study: Study

    def open(self) -> ChunkStore:
        """Create the folder if need be; raises UnusableInput where it holds another study or cannot be written."""
        path, current, stored = self.folder / IDENTITY, identity(self.study), None
        try:
            stored = json.loads(file_bytes(path))
        except FileNotFoundError:
            write_whole(path, json_text(current))
        except (OSError, ValueError, RecursionError) as error:
            raise UnusableInput(f"{path}: cannot be read; expected the identity of a study; remove it") from error
        difference = "" if stored is None else first_difference(stored if isinstance(stored, dict) else {}, current)
        if difference:
            fix = "expected the same study; choose another --out, or remove the folder"
            raise UnusableInput(f"{path}: the folder holds another study ({difference}); {fix}")
        # Also where no chunk is missing, and none will be written.
        return self

    @cached_property
    def _digest(self) -> bytes:
        return digest_of(self.study).encode()

    def path(self, part: Part) -> Path:
        """The file of a chunk."""
        return self.folder / CHUNKS / f"{part[0]:04d}-{part[1]:06d}.npz"

    def read(self, part: Part) -> Path:
        """As `Store`: the file of a chunk, of this study and with its end."""
        with zipfile.ZipFile(self.path(part)) as chunk:
            if chunk.comment != self._digest:
                raise LookupError("of another study")
        return self.path(part)

    def files(self, part: Part, result: bytes) -> dict[Path, bytes]:
        """As `Store`: the `packed` content of a chunk, with the digest of the study."""
        file = io.BytesIO(result)
        with zipfile.ZipFile(file, "a") as chunk:
            chunk.comment = self._digest
        return {self.path(part): file.getvalue()}

    def missing(self, parts: Iterable[Part]) -> list[Part]:
        """The chunks that are not there."""
        return [part for part in parts if self.kept(part) is None]

    def results(self, runs: Mapping[int, int]) -> Results:
        """The results of the stored chunks; `runs`: number of runs by index of the condition."""
        totals = {(index, name): Totals(count) for index, count in runs.items() for name in self.study.trackers}
        for part in ((index, k) for index, count in runs.items() for k in range(-(-count // self.study.chunk))):
            try:
                arrays = read_arrays(self.path(part))
                for k, name in enumerate(self.study.trackers):
                    of_tracker = {n.partition("/")[2]: x for n, x in arrays.items() if n.startswith(f"{k}/")}
                    sums = dict(zip(of_tracker.pop("columns").tolist(), of_tracker.pop("sums").T, strict=True))
                    totals[part[0], name].add(part[1] * self.study.chunk, of_tracker | sums)
            except (ValueError, LookupError, TypeError) as error:
                raise UnusableInput(
                    f"{self.path(part)}: not a chunk of a study; remove it and run the study again"
                ) from error
        return Results(self.study, totals, runs)


def packed(trackers: Sequence[Mapping[str, np.ndarray]]) -> bytes:
    """The content of a chunk's file, packed where it is computed: the caller stores the chunks of all workers. All sums
    of a tracker are one array."""
    file = io.BytesIO()
    # NumPy's level, 6, takes seven times as long, into files that are a tenth smaller.
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as members:
        for k, arrays in enumerate(trackers):
            columns = [name for name in arrays if name.startswith(("sum ", "largest "))]
            rest = {name: values for name, values in arrays.items() if name not in columns}
            sums = np.stack([arrays[name] for name in columns], axis=-1)
            for name, values in (rest | {"columns": np.array(columns), "sums": sums}).items():
                with members.open(f"{k}/{name}.npy", "w") as member:
                    np.lib.format.write_array(member, np.asanyarray(values), allow_pickle=False)
    return file.getvalue()
