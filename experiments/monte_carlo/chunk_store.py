"""The folder of a study: what it belongs to, and a file for every finished chunk, each written whole or not at all."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.monte_carlo.declaration import Study, TrackerConfig
from experiments.monte_carlo.results import ChunkTotals, Results, Totals
from trackers.core.errors import UnusableInput
from trackers.recordings.atomic import atomic_write, json_text

IDENTITY, CHUNKS = "study.json", "chunks"


def identity(study: Study) -> dict[str, Any]:
    """What makes a study's numbers these: its declaration, its file, the chunk, and what computes them."""
    return {
        "study": study.name,
        "worlds": {k: {"make": _named(w.make), "numbers": dict(w.numbers)} for k, w in study.worlds.items()},
        "trackers": {k: _config(e) for k, e in study.trackers.items()},
        "grid": {k: list(v) for k, v in study.grid.items()},
        "seed": study.seed,
        "chunk": study.chunk,
        "measures": list(study.measures),
        "kept of a first chunk": sorted({f for f in study.metrics if f.startswith("bound") or f == "us_per_row"}),
        "file": hashlib.sha256(study.source.encode()).hexdigest() if study.source else None,
        "jaxlib": version("jaxlib"),
        "device": jax.devices()[0].device_kind,
    }


def _named(function: Callable[..., Any]) -> str:
    inner = getattr(function, "func", function)
    return f"{getattr(inner, '__module__', '')}.{getattr(inner, '__qualname__', type(inner).__name__)}"


def _config(config: TrackerConfig) -> dict[str, Any]:
    name = config.tracker if isinstance(config.tracker, str) else config.tracker.about
    rest = {"smooth": config.smooth, "free_height": config.free_height, "every": config.every}
    return {"tracker": name, "tunables": dict(config.tunables), **rest}


@dataclass(frozen=True)
class ChunkStore:
    """The folder with the chunks of a study."""

    folder: Path
    study: Study

    def open(self) -> ChunkStore:
        """Made where it isn't there; raises UnusableInput where it holds another study or can't be written to."""
        path, mine = self.folder / IDENTITY, json_text(identity(self.study))
        try:
            (self.folder / CHUNKS).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UnusableInput(
                f"--out {self.folder}: cannot be created ({error.strerror}); choose another folder"
            ) from error
        if path.exists():
            other = unlike(path, mine)
            if other:
                raise UnusableInput(
                    f"{path}: the folder holds another study ({other}); expected the one that began it; choose another "
                    "--out, or remove the folder"
                )
        else:
            atomic_write(path, lambda temporary: temporary.write_text(mine, "utf-8"))
        return self

    def path(self, condition: int, chunk: int) -> Path:
        """The file of a cell's chunk."""
        return self.folder / CHUNKS / f"{condition:04d}-{chunk:06d}.npz"

    def has(self, condition: int, chunk: int) -> bool:
        """Whether a chunk is there and whole."""
        path = self.path(condition, chunk)
        return path.exists() and zipfile.is_zipfile(path)

    def put(self, condition: int, chunk: int, trackers: Sequence[Mapping[str, np.ndarray]]) -> None:
        """Write a chunk; raises UnusableInput where the disk is full."""
        arrays = {f"{k}/{name}": x for k, own in enumerate(trackers) for name, x in own.items()}

        def write(temporary: Path) -> None:
            with temporary.open("wb") as file:
                np.savez_compressed(file, **arrays)  # type: ignore[arg-type]

        atomic_write(self.path(condition, chunk), write)

    def results(self, runs: Mapping[int, int]) -> Results:
        """The figures of the cells of which so many runs are there."""
        kept: dict[tuple[int, str], Totals] = {}
        for condition in runs:
            gathered = {name: ChunkTotals(runs[condition]) for name in self.study.trackers}
            for chunk in range(-(-runs[condition] // self.study.chunk)):
                with self._file(condition, chunk) as file:
                    for k, name in enumerate(gathered):
                        own = {n.partition("/")[2]: file[n] for n in file.files if n.startswith(f"{k}/")}
                        gathered[name].add(chunk * self.study.chunk, own)
            kept |= {(condition, name): g.kept() for name, g in gathered.items()}
        return Results(self.study, kept, runs)

    def _file(self, condition: int, chunk: int) -> Any:
        path = self.path(condition, chunk)
        try:
            return np.load(path, allow_pickle=False)
        except (OSError, ValueError, zipfile.BadZipFile) as error:
            raise UnusableInput(f"{path}: is no chunk of a study; remove it and run the study again") from error


def unlike(path: Path, mine: str) -> str:
    """In a few words where the study of a folder differs from this one; empty where it doesn't."""
    try:
        other = json.loads(path.read_text("utf-8"))
        own = json.loads(mine)
    except (OSError, ValueError):
        return "its study.json cannot be read"
    for key in own:
        if other.get(key) != own[key]:
            return f"{key}: {_short(other.get(key))}, not {_short(own[key])}"
    return ""


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "…"


def merge_shards(parts: Sequence[Path], out: Path) -> int:
    """Copy the chunks of parts of one study into a folder, and say how many; raises UnusableInput for unequal ones."""
    if not parts:
        raise UnusableInput("study merge: no folder given; expected the folders that the shards wrote")
    texts = []
    for part in parts:
        path = part / IDENTITY
        try:
            texts.append(path.read_text("utf-8"))
        except (OSError, UnicodeDecodeError) as error:
            raise UnusableInput(
                f"{path}: cannot be read; expected the folder of a study, as --out of a shard"
            ) from error
        other = unlike(parts[0] / IDENTITY, texts[-1])
        if other:
            raise UnusableInput(f"{part}: is of another study than {parts[0]} ({other}); merge shards of one study")
    files = {path.name: path for part in parts for path in sorted((part / CHUNKS).glob("*.npz"))}
    try:
        (out / CHUNKS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnusableInput(f"--out {out}: cannot be created ({error.strerror}); choose another folder") from error
    for name, path in files.items():
        if path.parent != out / CHUNKS:
            atomic_write(out / CHUNKS / name, lambda temporary, path=path: temporary.write_bytes(path.read_bytes()))  # type: ignore[misc]
    atomic_write(out / IDENTITY, lambda temporary: temporary.write_text(texts[0], "utf-8"))
    return len(files)
