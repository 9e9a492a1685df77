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
from trackwright.trackers.programs.program_cache import give_back
from trackwright.trackers.recordings.atomic import Content, write_whole

WAKE_S = 0.25
"""Seconds after which a wait for parts looks for Ctrl-C: Polars lets system calls go on after it (SA_RESTART)."""

BLOCK = 256  # parts after which memory is freed, which otherwise grows with their number
Item = TypeVar("Item")
Result = TypeVar("Result")
Kept = TypeVar("Kept")


class Store(ABC, Generic[Item, Result, Kept]):
    """The finished parts of a job in a folder. The last file of a part is written when the others are there: where it
    is missing, of other inputs, or damaged, the part is computed again."""

    @abstractmethod
    def files(self, item: Item, result: Result) -> Mapping[Path, Content]:
        """The files of a part, the last one last; none for a part that is not kept."""

    @abstractmethod
    def read(self, item: Item) -> Kept:
        """What is kept of a part; raises any error where it is missing, of other inputs, or damaged."""

    def kept(self, item: Item) -> Kept | None:
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
    function: Callable[[Any], Result],
    store: Store[Item, Result, Any],
    executor: Executor,
    each: Callable[[Item, Any], None],
    read: Callable[[Item], Any] | None = None,
    failed: Callable[[Item, Exception], Result] | None = None,
) -> None:
    """Computes the parts that the store lacks; calls `each` with every item and what is kept of it, or its result.
    `function`: of an item, or of what `read`, which runs here, returns of it. `failed`: the result of a part that could
    not be read or computed; without it such a part ends the run."""

    def missing() -> Iterator[Item]:
        for item in items:
            kept = store.kept(item)
            if kept is None:
                yield item
            else:
                each(item, kept)

    def submit(item: Item) -> Future[Any]:
        try:
            given = item if read is None else read(item)
        except Exception as error:
            unread: Future[Any] = Future()
            unread.set_result(_instead(error, failed, item))
            return unread
        return executor.submit(attempted, function, given, failed, item)

    parts = finished(submit, missing(), getattr(executor, "at_once", AT_ONCE), failed)
    for count, (item, result) in enumerate(parts, 1):
        store.keep(item, result)
        each(item, result)
        if count % BLOCK == 0:
            # Left alone, the collector hardly runs beside the many objects of jax, and tables wait for it.
            gc.collect()
            give_back()


def attempted(
    function: Callable[[Any], Any], given: Any, failed: Callable[[Any, Exception], Any] | None, item: Any
) -> Any:
    """Where a part is computed: its result, or what stands for it where it fails."""
    try:
        return function(given)
    except Exception as error:
        return _instead(error, failed, item)


def _instead(error: Exception, failed: Callable[[Any, Exception], Any] | None, item: Any) -> Any:
    if failed is None:
        raise error
    return failed(item, error)


def finished(
    submit: Callable[[Item], Future[Any]],
    items: Iterable[Item],
    at_once: int = AT_ONCE,
    failed: Callable[[Item, Exception], Any] | None = None,
) -> Iterator[tuple[Item, Any]]:
    """Each item with the result of its submitted part, as parts finish; at most `at_once` are submitted at a time.
    `failed`: the result of a part whose workers ended again and again. Parts that have not begun are cancelled where
    one fails, and where the caller stops."""
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
                if isinstance(error, Exception) and type(error).__name__ == "KilledWorker":
                    yield item, _instead(error, failed, item)
                else:
                    yield item, future.result()
    finally:
        for future in waiting:
            future.cancel()
