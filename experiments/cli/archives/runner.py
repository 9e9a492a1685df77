"""Run what is missing of an archive, on threads or on a cluster: one recording at a time, each by itself."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from trackwright.experiments.cli.archives.part import Found, guarded
from trackwright.experiments.cli.archives.store import Item, RecordingStore
from trackwright.experiments.cli.archives.tables import Refusals
from trackwright.experiments.jobs.executors import cluster_executor, finished
from trackwright.trackers.core.run.chunks import n_workers
from trackwright.trackers.programs.freed_memory import give_back

BLOCK = 256
"""Recordings after which memory is freed, which otherwise grows with their number."""


def _lost(item: Item) -> Found:
    """The refusal of a recording that ends its workers."""
    fix = "expected enough memory for one recording a worker; see the workers' logs"
    return Found(refused=[f"{item.path}: its workers ended while they computed it; {fix}"])


def run_missing(
    store: RecordingStore,
    items: Iterable[Item],
    read: Callable[[Item], Any],
    part: Callable[[Any], Found],
    cluster: str | None,
    advance: Callable[[int], None],
) -> tuple[set[Path], Refusals]:
    """Run the part of each recording that is not stored; the finished recordings, and a line for each refusal.

    `read`: what the part is given of a recording. Threads read for themselves; for a cluster the caller reads, since
    its workers need not see the files. Recordings of which nothing was found are tried again by the next run.
    """
    done: set[Path] = set()
    refused: Refusals = {}

    def missing() -> Iterator[Item]:
        for item in items:
            kept = store.read(item.folder, item.fingerprint)
            if kept is None:
                yield item
            else:
                advance(1)
                done.add(item.path)
                if kept["refused"]:
                    refused[item.path] = kept["refused"]

    def whole(item: Item) -> Found:
        return part(read(item))

    workers = n_workers()
    with cluster_executor(cluster) if cluster else ThreadPoolExecutor(workers) as executor:

        def submit(item: Item) -> Future[Any]:
            if cluster is None:
                return executor.submit(guarded, item.path, whole, item)
            source = guarded(item.path, read, item)
            if isinstance(source, Found):
                unread: Future[Any] = Future()
                unread.set_result(source)
                return unread
            return executor.submit(guarded, item.path, part, source)

        at_once = getattr(executor, "at_once", 2 * workers)
        for count, (item, result) in enumerate(finished(submit, missing(), at_once, _lost), 1):
            found = result.in_lines()
            if found.outcomes:
                store.write(item, found)
                done.add(item.path)
            if found.refused:
                refused[item.path] = found.refused
            advance(1)
            if count % BLOCK == 0:
                # Left alone, the collector hardly runs beside the many objects of jax, and tables wait for it.
                gc.collect()
                give_back()
    return done, refused
