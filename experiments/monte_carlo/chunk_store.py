"""The folder of a study: its identity, and one file per finished chunk."""

from __future__ import annotations

import functools
import hashlib
import io
import json
import shutil
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from trackwright.experiments.jobs.run import Store, written
from trackwright.experiments.monte_carlo.declaration import Study, TrackerConfig
from trackwright.experiments.monte_carlo.results import Results, Totals
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.atomic import json_text, remove_abandoned
from trackwright.trackers.recordings.input_file import file_bytes, read_arrays

IDENTITY, CHUNKS = "study.json", "chunks"
FORMAT = 2  # of the files of chunks; a folder with another format holds another study
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


@dataclass(frozen=True)
class ChunkStore(Store[Part, bytes, Path]):
    """The folder with the finished chunks of a study."""

    folder: Path
    study: Study

    def open(self) -> ChunkStore:
        """Create the folder if need be; raises UnusableInput where it holds another study or cannot be written."""
        path, current = self.folder / IDENTITY, identity(self.study)
        if path.exists():
            difference = first_difference(_stored(path), current)
            if difference:
                fix = "expected the same study; choose another --out, or remove the folder"
                raise UnusableInput(f"{path}: the folder holds another study ({difference}); {fix}")
        else:
            written(self.folder, {IDENTITY: _text(current)})
        # Also where no chunk is missing, and none will be written.
        remove_abandoned(self.folder / CHUNKS)
        return self

    def path(self, part: Part) -> Path:
        """The file of a chunk."""
        index, chunk = part
        return self.folder / CHUNKS / f"{index:04d}-{chunk:06d}.npz"

    def kept(self, part: Part) -> Path | None:
        """The file of a chunk, None where it is not there or has lost its end."""
        path = self.path(part)
        return path if path.is_file() and zipfile.is_zipfile(path) else None

    def keep(self, part: Part, content: bytes) -> Path:
        """Write the `packed` content of a chunk; raises UnusableInput where the disk is full."""
        path = self.path(part)
        written(path.parent, {path.name: lambda temporary: temporary.write_bytes(content)})
        return path

    def results(self, runs: Mapping[int, int]) -> Results:
        """The results of the stored chunks; `runs`: number of runs by index of the condition."""
        totals = {(index, name): Totals(count) for index, count in runs.items() for name in self.study.trackers}
        for index in runs:
            for chunk in range(-(-runs[index] // self.study.chunk)):
                path = self.path((index, chunk))
                try:
                    arrays = read_arrays(path)
                    for k, name in enumerate(self.study.trackers):
                        of_tracker = {n.partition("/")[2]: x for n, x in arrays.items() if n.startswith(f"{k}/")}
                        totals[index, name].add(chunk * self.study.chunk, expanded(of_tracker))
                except (ValueError, LookupError, TypeError) as error:
                    raise UnusableInput(f"{path}: not a chunk of a study; remove it and run the study again") from error
        return Results(self.study, totals, runs)


def packed(trackers: Sequence[Mapping[str, np.ndarray]]) -> bytes:
    """The content of a chunk's file, packed where it is computed: the caller stores the chunks of all workers."""
    file = io.BytesIO()
    # NumPy's level, 6, takes seven times as long, into files that are a tenth smaller.
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as members:
        for k, arrays in enumerate(trackers):
            for name, values in compact(arrays).items():
                with members.open(f"{k}/{name}.npy", "w") as member:
                    np.lib.format.write_array(member, np.asanyarray(values), allow_pickle=False)
    return file.getvalue()


def compact(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of a chunk as files hold them: histograms as the distances of their cells and the counts, in few bits.
    Equal histograms are there once, under the names of all their kinds. All sums are one array."""
    result = {name: x for name, x in arrays.items() if not name.startswith(("cells ", "counts ", "sum ", "largest "))}
    columns = [name for name in arrays if name.startswith(("sum ", "largest "))]
    if columns:
        result |= {"columns": np.array(columns), "sums": np.stack([arrays[name] for name in columns], axis=-1)}
    alike: list[tuple[list[str], tuple[np.ndarray, np.ndarray]]] = []
    for kind in (name.partition(" ")[2] for name in arrays if name.startswith("cells ")):
        mine = arrays[f"cells {kind}"], arrays[f"counts {kind}"]
        if alike and all(map(np.array_equal, mine, alike[-1][1])):
            alike[-1][0].append(kind)
        else:
            alike.append(([kind], mine))
    for kinds, (cells, counts) in alike:
        histogram = np.stack([np.diff(cells, prepend=0), counts])
        result[f"histograms {' '.join(kinds)}"] = histogram.astype(np.min_scalar_type(histogram.max(initial=0)))
    return result


def expanded(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of a chunk from its file."""
    result: dict[str, np.ndarray] = {}
    for name, values in arrays.items():
        what, *kinds = name.split(" ")
        if what == "histograms":
            cells = np.cumsum(values[0], dtype=np.int64)
            result |= {f"{part} {kind}": x for kind in kinds for part, x in (("cells", cells), ("counts", values[1]))}
        elif what == "sums":
            result |= dict(zip(arrays["columns"].tolist(), values.T, strict=True))
        elif what != "columns":
            result[name] = values
    return result


def first_difference(other: Mapping[str, Any], mine: Mapping[str, Any]) -> str:
    """The first key in which two identities differ, and both values; empty for none."""
    for key in mine:
        if other.get(key) != mine[key]:
            return f"{key}: {_short(other.get(key))}, not {_short(mine[key])}"
    return ""


def _stored(path: Path) -> dict[str, Any]:
    """The identity in a study.json; raises UnusableInput where there is none."""
    try:
        stored = json.loads(file_bytes(path))
    except (OSError, ValueError, RecursionError) as error:
        raise UnusableInput(f"{path}: cannot be read; expected the identity of a study, as its --out holds") from error
    if not isinstance(stored, dict):
        raise UnusableInput(f"{path}: holds no table; expected the identity of a study, as its --out holds")
    return stored


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "…"


def merge_shards(parts: Sequence[Path], out: Path) -> int:
    """Copy the chunks of a study's shards into a folder; their number. Raises UnusableInput for different studies."""
    if not parts:
        raise UnusableInput("study merge: no folder given; expected the folders of its shards")
    identities = [_stored(part / IDENTITY) for part in parts]
    for part, stored in zip(parts, identities, strict=True):
        difference = first_difference(identities[0], stored)
        if difference:
            words = f"holds another study than {parts[0]} ({difference})"
            raise UnusableInput(f"{part}: {words}; expected shards of one study; remove it")
    chunks = {path.name: path for part in parts for path in sorted((part / CHUNKS).glob("[0-9]*.npz"))}
    for name, path in chunks.items():
        if path.parent != out / CHUNKS:
            written(out / CHUNKS, {name: functools.partial(shutil.copyfile, path)})
    written(out, {IDENTITY: _text(identities[0])})
    return len(chunks)


def _text(identity: Mapping[str, Any]) -> Callable[[Path], object]:
    return lambda path: path.write_text(json_text(identity), "utf-8")
