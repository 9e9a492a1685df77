"""The chunks of a fit in the memory of a cluster's workers; per evaluation vectors go there, and sums come back."""

from __future__ import annotations

import functools
import pickle
import platform
import shutil
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from trackwright.experiments.jobs import executors
from trackwright.experiments.jobs.executors import computed
from trackwright.experiments.jobs.portable import file_of, spec_here
from trackwright.experiments.jobs.store import finished
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.tuning.batches import lengths_of
from trackwright.tuning.parts import Computation, Parts, Point, on_chunk

HeldChunk = tuple[str, str, bytes, bytes, list[np.ndarray]]
"""Name and file of the tracker, pickled point, pickled structure of a chunk, its arrays: nothing that imports jax."""


class FitWorkers(NamedTuple):
    """The workers of a fit: Dask's client, the environment expected of them, and a folder that they all see."""

    client: Any
    expected: Mapping[str, Any]
    folder: Path


@contextmanager
def fit_workers(cluster: str, out: Path) -> Iterator[FitWorkers]:
    """The workers of a cluster with a folder of their files in `out`, emptied first."""
    folder = out / ".tune-parts"
    shutil.rmtree(folder, ignore_errors=True)
    try:
        with executors.cluster_client(cluster) as (client, expected):
            folder.mkdir()
            yield FitWorkers(client, expected, folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError):
            out.rmdir()  # if nothing was written


class HeldParts(Parts):
    """The chunks of a problem with workers, each of which loads its own from files, again elsewhere if a worker is
    lost. The bits are as of `LocalParts`: the same programs, and the results in the order of the chunks."""

    def __init__(self, workers: FitWorkers, named: NamedTracker, point: Point, pieces: Iterable[Batch]) -> None:
        self.workers, self.rows, self.held = workers, list[Any](), list[Any]()
        self.executor = workers.client.get_executor(pure=False)
        text = file_of(named.name)
        try:
            model = pickle.dumps(point)
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            fix = "expected classes and functions of a module; define them at the top of its file"
            raise UnusableInput(
                f"--cluster: tracker '{named.name}' cannot be sent to workers ({error}); {fix}"
            ) from error
        for piece in pieces:
            path = workers.folder / f"{uuid.uuid4().hex}.npz"
            leaves, structure = jax.tree_util.tree_flatten(piece)
            numbers = jax.tree_util.tree_unflatten(structure, range(len(leaves)))
            atomic_write(path, functools.partial(_write, leaves))
            call = pickle.dumps((loaded, (named.name, text, model, pickle.dumps(numbers), path), {}))
            self.rows.append(lengths_of(piece))
            # A prefix of its own: Dask estimates the duration of a task by those with the same one.
            key = f"load-{uuid.uuid4().hex}"
            self.held.append(workers.client.submit(computed, workers.expected, call, key=key, pure=False))

    def compute(self, computation: Computation) -> list[list[Any]]:
        """As `Parts`."""
        call = pickle.dumps((evaluated, (computation,), {}))

        def submit(k: int) -> Future[Any]:
            return self.executor.submit(computed, self.workers.expected, call, self.held[k])

        results = dict(finished(submit, range(len(self.held)), at_once=len(self.held)))
        return [results[k] for k in range(len(self.held))]


def _write(leaves: Sequence[np.ndarray], path: Path) -> None:
    with path.open("wb") as file:
        np.savez(file, *leaves, allow_pickle=False)


def loaded(name: str, text: str, model: bytes, structure: bytes, path: Path) -> HeldChunk:
    """In a worker: a chunk from its file; raises UnusableInput where the file is not seen."""
    try:
        with np.load(path) as arrays:
            return name, text, model, structure, [arrays[f"arr_{k}"] for k in range(len(arrays.files))]
    except OSError as error:
        fix = "expected a folder that all workers see under the same name; choose another --out"
        raise UnusableInput(f"worker on {platform.node()}: cannot read {path} ({error.strerror}); {fix}") from error


def evaluated(held: HeldChunk, computation: Computation) -> list[Any]:
    """In a worker: the results of the chunk that it holds."""
    name, text, model, structure, arrays = held
    numbers, treedef = jax.tree_util.tree_flatten(_unpickled(structure))
    piece = jax.tree_util.tree_unflatten(treedef, [arrays[k] for k in numbers])
    spec_here(name, text)
    return on_chunk(_unpickled(model), piece, computation)


@functools.lru_cache(maxsize=8)
def _unpickled(content: bytes) -> Any:
    """What is pickled, made once: objects that programs tell apart by identity stay the same."""
    return pickle.loads(content)
