"""Carrying a study out: what is missing of its chunks, on all devices, until figures are known well enough."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import jax
import numpy as np

from experiments.cli.console import Advance
from experiments.monte_carlo.chunk import run_chunk
from experiments.monte_carlo.chunk_store import ChunkStore
from experiments.monte_carlo.declaration import Condition, Study
from experiments.monte_carlo.results import NAMES, Results
from trackers.core.chunks import n_workers
from trackers.core.errors import UnusableInput

CHUNKS_PER_DEVICE = 4
"""A device takes part from so many chunks on: every device compiles the trackers for itself."""


@dataclass(frozen=True)
class StopRule:
    """A figure and the half width of its interval, relative to it, at which a cell has runs enough."""

    metric: str
    share: float

    @classmethod
    def parse(cls, text: str, study: Study) -> StopRule:
        """From text as `rmse_m±1%`; raises UnusableInput for other text."""
        found = re.fullmatch(r"\s*(\w+)\s*(?:±|\+-|\+/-)\s*([0-9.]+)\s*%\s*", text)
        known = (*NAMES, *study.measures)
        if found is None or found[1] not in known or not 0 < float(found[2]) < 100:
            raise UnusableInput(
                f'--until "{text}": expected a figure and a width, as "rmse_m±1%"; figures: {", ".join(known)}'
            )
        return cls(found[1], float(found[2]) / 100)

    def reached(self, results: Results, condition: Condition) -> bool:
        """Whether the figure is known so well for every tracker that has it."""
        for tracker in results.study.trackers:
            value = results.at(self.metric, condition, tracker)
            if np.isfinite(value.value) and value.high - value.low > 2 * self.share * abs(value.value):
                return False
        return True


def run_study(
    study: Study, folder: Path, shard: tuple[int, int], until: StopRule | None, advance: Advance
) -> Results | None:
    """Run what is missing; the figures, or None where chunks of other shards are missing still.

    With `until` a cell ends after 1, 2, 4, 8 … chunks, as soon as its figure is known well enough, however many devices
    there are. Raises UnusableInput where the folder holds another study, and where `until` is asked of a shard.
    """
    if until is not None and shard != (1, 1):
        raise UnusableInput("--until with --shard: a shard doesn't see the others' runs; leave one of them out")
    store = ChunkStore(folder, study).open()
    if until is None:
        every = [(condition, k) for condition in study.conditions for k in range(study.chunks)]
        run_missing(store, every[shard[0] - 1 :: shard[1]], advance)
        runs = {condition.index: study.runs for condition in study.conditions}
    else:
        runs = {condition.index: _run_until(store, condition, until, advance) for condition in study.conditions}
    whole = all(store.has(condition, k) for condition, n in runs.items() for k in range(-(-n // study.chunk)))
    return store.results(runs) if whole else None


def _run_until(store: ChunkStore, condition: Condition, until: StopRule, advance: Advance) -> int:
    study, enough, done = store.study, 1, 0
    while True:
        wanted = min(enough, study.chunks)
        run_missing(store, [(condition, k) for k in range(done, wanted)], advance)
        runs, done = min(enough * study.chunk, study.runs), wanted
        if runs == study.runs or until.reached(store.results({condition.index: runs}), condition):
            advance(study.chunks - wanted)
            return runs
        enough *= 2


def run_missing(store: ChunkStore, chunks: Sequence[tuple[Condition, int]], advance: Advance) -> None:
    """Run those of the chunks that aren't there yet, as many at once as the host can."""
    missing = [(condition, k) for condition, k in chunks if not store.has(condition.index, k)]
    advance(len(chunks) - len(missing))
    devices: SimpleQueue[Any] = SimpleQueue()
    taking_part = jax.local_devices()[: max(1, len(missing) // CHUNKS_PER_DEVICE)]
    workers = n_workers() * len(taking_part) // jax.local_device_count()
    for k in range(workers):
        devices.put(taking_part[k % len(taking_part)])
    size = store.study.chunk

    def run(condition: Condition, chunk: int) -> None:
        device = devices.get()
        try:
            with jax.default_device(device):
                began, ids = time.perf_counter(), np.arange(chunk * size, (chunk + 1) * size)
                kept = run_chunk(store.study, condition, ids, first=chunk == 0)
                kept[0]["seconds"] = np.array(time.perf_counter() - began)
                store.put(condition.index, chunk, kept)
        finally:
            devices.put(device)
        advance(1, condition.label)

    with ThreadPoolExecutor(workers) as pool:
        waiting = [pool.submit(run, *one) for one in missing]
        try:
            for one in as_completed(waiting):
                one.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
