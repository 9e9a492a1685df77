"""Run a study: its missing chunks on threads or on workers, and its folder with a file for each finished one."""

from __future__ import annotations

import functools
import io
import json
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from trackwright.experiments.jobs.executors import Threads
from trackwright.experiments.jobs.store import Store, run
from trackwright.experiments.monte_carlo.chunk import require_fitting_parts, run_chunk
from trackwright.experiments.monte_carlo.declaration import Study, TrackerConfig
from trackwright.experiments.monte_carlo.results import Results, Totals
from trackwright.experiments.monte_carlo.sources import load_study
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.programs import keep
from trackwright.trackers.recordings.files import config_hash, file_bytes, json_text, read_arrays, write_whole

IDENTITY, CHUNKS = "study.json", "chunks"
FORMAT = 6  # of the files of chunks; a folder with another format holds another study
Part = tuple[int, int]  # a chunk: the index of its condition, and its number among the chunks of that
Advance = Callable[..., None]
"""Progress: called with the number of finished chunks, and optionally the label of a condition."""


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
        "file": config_hash({"text": study.source}) if study.source else None,
        "jaxlib": version("jaxlib"),
        "device": jax.devices()[0].device_kind,
    }
    plain: dict[str, Any] = json.loads(json_text(content))
    return plain


def digest_of(study: Study) -> str:
    """The digest of a study's identity."""
    return config_hash(identity(study))


def _named(function: Callable[..., Any]) -> str:
    inner = getattr(function, "func", function)
    return f"{getattr(inner, '__module__', '')}.{getattr(inner, '__qualname__', type(inner).__name__)}"


def _config(config: TrackerConfig) -> dict[str, Any]:
    name = config.tracker if isinstance(config.tracker, str) else config.tracker.about
    if isinstance(config.tracker, str) and (file := name.rpartition(":")[0]):
        name += f" {config_hash({'text': Path(file).read_text('utf-8')})}"
    rest = {"smooth": config.smooth, "free_height": config.free_height, "every": config.every}
    return {"tracker": name, "tunables": dict(config.tunables), **rest}


@dataclass(frozen=True)
class ChunkStore(Store[Part, bytes]):
    """The folder with the finished chunks of a study; each file names the digest of the study's identity."""

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
        stored = current if stored is None else stored if isinstance(stored, dict) else {}
        for key in (key for key in current if stored.get(key) != current[key]):
            found = f"{key}: {str(stored.get(key))[:60]}, not {str(current[key])[:60]}"
            raise UnusableInput(f"{path}: the folder holds another study ({found}); choose another --out, or remove it")
        return self

    @cached_property
    def _digest(self) -> bytes:
        return digest_of(self.study).encode()

    def path(self, part: Part) -> Path:
        """The file of a chunk."""
        return self.folder / CHUNKS / f"{part[0]:04d}-{part[1]:06d}.npz"

    def read(self, item: Part) -> Path:
        """As `Store`: the file of a chunk, of this study and with its end."""
        with zipfile.ZipFile(self.path(item)) as chunk:
            if chunk.comment != self._digest:
                raise LookupError("of another study")
        return self.path(item)

    def files(self, item: Part, result: bytes) -> dict[Path, bytes]:
        """As `Store`: the `packed` content of a chunk, with the digest of the study."""
        file = io.BytesIO(result)
        with zipfile.ZipFile(file, "a") as chunk:
            chunk.comment = self._digest
        return {self.path(item): file.getvalue()}

    def results(self) -> Results:
        """The results of the stored chunks."""
        study, pairs = self.study, [(c.index, name) for c in self.study.conditions for name in self.study.trackers]
        totals = {pair: Totals(study.runs) for pair in pairs}
        for part in ((condition.index, k) for condition in study.conditions for k in range(study.chunks)):
            try:
                alike = read_arrays(self.path(part)).items()
                arrays = {name: x for names, rows in alike for name, x in zip(names.split("\n"), rows, strict=True)}
                for k, name in enumerate(study.trackers):
                    of_tracker = {n.partition("/")[2]: x for n, x in arrays.items() if n.startswith(f"{k}/")}
                    totals[part[0], name].add(part[1] * study.chunk, of_tracker)
            except (ValueError, LookupError, TypeError) as error:
                raise UnusableInput(f"{self.path(part)}: no chunk of a study; remove it, and run it again") from error
        return Results(study, totals)


def packed(trackers: Sequence[Mapping[str, np.ndarray]]) -> bytes:
    """The content of a chunk's file, packed where it is computed: the caller stores the chunks of all workers."""
    # Arrays of one shape and type are one, named after all: each by itself takes longer to read than its numbers.
    file, alike = io.BytesIO(), dict[tuple[Any, ...], dict[str, np.ndarray]]()
    for name, x in ((f"{k}/{name}", x) for k, of in enumerate(trackers) for name, x in of.items()):
        alike.setdefault((x.shape, x.dtype), {})[name] = x
    # As `np.savez_compressed`, whose level of compression takes seven times as long and saves a seventh.
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as chunk:
        for arrays in alike.values():
            with chunk.open("\n".join(arrays) + ".npy", "w") as member:
                np.lib.format.write_array(member, np.stack([*arrays.values()]), allow_pickle=False)
    return file.getvalue()


def run_study(
    study: Study, folder: Path, advance: Advance = lambda *_: None, executor: Executor | None = None
) -> Results:
    """Run the missing chunks of a study, on the executor or as many in parallel as the host allows; its results.
    Raises UnusableInput for a folder of another study."""
    if not (folder / IDENTITY).exists():
        require_fitting_parts(study)
    store = ChunkStore(folder, study).open()
    parts = [(condition.index, k) for condition in study.conditions for k in range(study.chunks)]
    labels = [condition.label for condition in study.conditions]

    def each(part: Part, kept: object) -> None:
        advance(1, labels[part[0]])

    if executor is None:
        keep()
        with Threads() as threads:
            run(parts, functools.partial(packed_chunk, study), store, threads, each)
        return store.results()
    if not study.declared_in:
        raise UnusableInput(f"study '{study.name}': built in memory; expected one loaded from a file, as workers do it")
    declared = study.declared_in, study.runs, study.seed, digest_of(study)
    run(parts, functools.partial(_declared_chunk, *declared), store, executor, each)
    return store.results()


@functools.lru_cache(maxsize=4)
def _declared(what: str, runs: int, seed: int, digest: str) -> Study:
    """In a worker: the study of a name or file, with its numbers; kept, since its programs are compiled.

    Raises UnusableInput where its `digest` is another one: changed in memory, or another file at this place.
    """
    study = load_study(what, runs, seed)
    if digest_of(study) != digest:
        fix = "expected the caller's files at the same places, and no change in memory; write the change to the file"
        raise UnusableInput(f"study '{study.name}': a worker has another declaration of {what}; {fix}")
    return study


def _declared_chunk(what: str, runs: int, seed: int, digest: str, part: Part) -> bytes:
    """In a worker: the content of a chunk's file, of a study by its name or file."""
    return packed_chunk(_declared(what, runs, seed, digest), part)


def packed_chunk(study: Study, part: Part) -> bytes:
    """The content of a chunk's file: what `run_chunk` returns, and the computing time of all trackers, s."""
    index, chunk = part
    start, ids = time.perf_counter(), np.arange(chunk * study.chunk, (chunk + 1) * study.chunk)
    arrays = run_chunk(study, study.conditions[index], ids, first=chunk == 0)
    arrays[0]["seconds"] = np.array(time.perf_counter() - start)
    return packed(arrays)
