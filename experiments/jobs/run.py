"""Independent parts of long work: those that a store lacks are computed on an executor, and kept as they finish."""

from __future__ import annotations

import gc
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from itertools import islice
from pathlib import Path
from typing import Any, Generic, TypeVar

from trackwright.experiments.jobs.executors import AT_ONCE
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.programs.process_settings import give_back
from trackwright.trackers.recordings.atomic import atomic_write

WAKE_S = 0.25
"""Seconds after which a wait for parts looks for Ctrl-C: Polars lets system calls go on after it (SA_RESTART)."""

BLOCK = 256  # parts after which memory is freed, which otherwise grows with their number
Item = TypeVar("Item")
Result = TypeVar("Result")
Kept = TypeVar("Kept")


class Store(ABC, Generic[Item, Result, Kept]):
    """The finished parts of a job in a folder. Files are written under a temporary name and renamed, the last one of a
    part when the others are there: where it is missing, of other inputs, or damaged, the part is computed again."""

    @abstractmethod
    def kept(self, item: Item) -> Kept | None:
        """What is kept of a part; None where it is missing, of other inputs, or damaged."""

    @abstractmethod
    def keep(self, item: Item, result: Result) -> Kept:
        """Keeps the result of a part; raises UnusableInput as `written`."""


def written(folder: Path, files: Mapping[str, Callable[[Path], object]]) -> None:
    """Writes the files of a part, the last one last, which says that it is whole; raises UnusableInput."""
    *others, last = files
    try:
        for name in files:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
        if others:
            # What it says is no longer true of the files that are replaced.
            (folder / last).unlink(missing_ok=True)
    except OSError as error:
        raise UnusableInput(f"--out {folder}: cannot be created ({error.strerror}); choose another folder") from error
    for name, write in files.items():
        atomic_write(folder / name, write)


def run(
    items: Iterable[Item], function: Callable[[Any], Result], store: Store[Item, Result, Kept], executor: Executor,
    each: Callable[[Item, Kept], None], read: Callable[[Item], Any] | None = None,
    failed: Callable[[Item, Exception], Result] | None = None,
) -> None:  # fmt: skip
    """Computes the parts that the store lacks, and calls `each` with every item and what is kept of it. `function`: of
    an item, or of what `read`, which runs here, returns of it. `failed`: the result of a part that could not be read or
    computed; without it such a part ends the run."""

    def missing() -> Iterator[Item]:
        for item in items:
            kept = store.kept(item)
            if kept is None:
                yield item
            else:
                each(item, kept)

    def submit(item: Item) -> Future[Any]:
        if failed is None:
            return executor.submit(function, item if read is None else read(item))
        try:
            given = item if read is None else read(item)
        except Exception as error:
            unread: Future[Any] = Future()
            unread.set_result(failed(item, error))
            return unread
        return executor.submit(attempted, function, given, failed, item)

    parts = finished(submit, missing(), getattr(executor, "at_once", AT_ONCE), failed)
    for count, (item, result) in enumerate(parts, 1):
        each(item, store.keep(item, result))
        if count % BLOCK == 0:
            # Left alone, the collector hardly runs beside the many objects of jax, and tables wait for it.
            gc.collect()
            give_back()


def attempted(
    function: Callable[[Any], Result], given: Any, failed: Callable[[Item, Exception], Result], item: Item
) -> Result:
    """Where a part is computed: its result, or what stands for it where it fails."""
    try:
        return function(given)
    except Exception as error:
        return failed(item, error)


def finished(
    submit: Callable[[Item], Future[Any]], items: Iterable[Item], at_once: int = AT_ONCE,
    lost: Callable[[Item, Exception], Any] | None = None,
) -> Iterator[tuple[Item, Any]]:  # fmt: skip
    """Each item with the result of its submitted part, as parts finish; at most `at_once` are submitted at a time.
    `lost`: the result of a part whose workers ended again and again; without it, that is a failure. Parts that have not
    begun are cancelled where one fails, and where the caller stops."""
    waiting: dict[Future[Any], Item] = {}
    remaining = iter(items)
    try:
        while True:
            for item in islice(remaining, at_once - len(waiting)):
                waiting[submit(item)] = item
            if not waiting:
                return
            for future in wait(waiting, WAKE_S, FIRST_COMPLETED).done:
                item, error = waiting.pop(future), future.exception()
                if lost is not None and isinstance(error, Exception) and type(error).__name__ == "KilledWorker":
                    yield item, lost(item, error)
                else:
                    yield item, future.result()
    finally:
        for future in waiting:
            future.cancel()
