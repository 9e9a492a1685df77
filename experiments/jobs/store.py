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
from trackwright.trackers.core.programs import give_back
from trackwright.trackers.recordings.files import Content, write_whole

WAKE_S = 0.25
"""Seconds after which a wait for parts looks for Ctrl-C: Polars lets system calls go on after it (SA_RESTART)."""

BLOCK = 256  # parts after which memory is freed, which otherwise grows with their number
LOST = ("CancelledError", "CommClosedError")  # errors of the way to the workers, which end a run
Item = TypeVar("Item")
Result = TypeVar("Result")


class Store(ABC, Generic[Item, Result]):
    """The finished parts of a job in a folder. The last file of a part is written when the others are there: where it
    is missing, of other inputs, or damaged, the part is computed again."""

    @abstractmethod
    def files(self, item: Item, result: Result) -> Mapping[Path, Content]:
        """The files of a part, the last one last; none for a part that is not kept."""

    @abstractmethod
    def read(self, item: Item) -> Any:
        """What is kept of a part; raises any error where it is missing, of other inputs, or damaged."""

    def kept(self, item: Item) -> Any:
        """What is kept of a part; None where that is nothing usable."""
        try:
            return self.read(item)
        except Exception:
            return None

    def keep(self, item: Item, result: Result) -> None:
        """Keeps the result of a part; raises UnusableInput where it cannot be written."""
        files = self.files(item, result)
        if len(files) > 1:
            # What the last file says is no longer true of the files that are replaced.
            [*files][-1].unlink(missing_ok=True)
        for path, content in files.items():
            write_whole(path, content)


def run(
    items: Iterable[Item],
    function: Callable[[Item], Result],
    store: Store[Item, Result],
    executor: Executor,
    each: Callable[[Item, Any], None],
    failed: Callable[[Item, Exception], Result] | None = None,
) -> None:
    """Computes the parts that the store lacks; calls `each` with every item and what is kept of it, or its result.
    `failed`: the result of a part that could not be computed; without it such a part ends the run."""

    def missing() -> Iterator[Item]:
        for item in items:
            kept = store.kept(item)
            if kept is None:
                yield item
            else:
                each(item, kept)

    parts = finished(lambda item: executor.submit(function, item), missing(), getattr(executor, "at_once", AT_ONCE))
    for count, (item, future) in enumerate(parts, 1):
        error = future.exception()
        if failed is not None and isinstance(error, Exception) and type(error).__name__ not in LOST:
            result = failed(item, error)
        else:
            result = future.result()
        store.keep(item, result)
        each(item, result)
        if count % BLOCK == 0:
            # Left alone, the collector hardly runs beside the many objects of jax, and tables wait for it.
            gc.collect()
            give_back()


def finished(
    submit: Callable[[Item], Future[Any]], items: Iterable[Item], at_once: int = AT_ONCE
) -> Iterator[tuple[Item, Future[Any]]]:
    """Each item with its submitted part, as parts finish; at most `at_once` are submitted at a time. Parts that have
    not begun are cancelled where the caller stops."""
    waiting: dict[Future[Any], Item] = {}
    remaining = iter(items)
    try:
        while True:
            for item in islice(remaining, at_once - len(waiting)):
                waiting[submit(item)] = item
            if not waiting:
                return
            for future in wait(waiting, WAKE_S, FIRST_COMPLETED).done:
                yield waiting.pop(future), future
    finally:
        for future in waiting:
            future.cancel()
