"""Run a study's missing chunks, on all devices, up to a number of runs or until intervals are narrow enough."""

from __future__ import annotations

import functools
import re
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from trackwright.experiments.jobs.executors import Threads
from trackwright.experiments.jobs.store import run
from trackwright.experiments.monte_carlo.chunk import require_fitting_parts, run_chunk
from trackwright.experiments.monte_carlo.declaration import Condition, Study
from trackwright.experiments.monte_carlo.results import NAMES, Results
from trackwright.experiments.monte_carlo.sources import declared_again
from trackwright.experiments.monte_carlo.store import IDENTITY, ChunkStore, Part, digest_of, packed
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.programs.program_cache import keep

CHUNKS_PER_DEVICE = 4  # chunks for which another device is used: every device compiles the trackers again
Advance = Callable[..., None]
"""Progress: called with the number of finished chunks, and optionally the label of a condition."""


@dataclass(frozen=True)
class StopRule:
    """Stop a condition once the interval of `metric` is at most ± `half_width`, relative to its value."""

    metric: str
    half_width: float

    @classmethod
    def parse(cls, text: str, study: Study) -> StopRule:
        """The rule of a text such as `rmse_m±1%`; raises UnusableInput for other texts."""
        match = re.fullmatch(r"\s*(\w+)\s*(?:±|\+-|\+/-)\s*([0-9.]+)\s*%\s*", text)
        known = (*NAMES, *study.measures)
        if match is None or match[1] not in known or not 0 < float(match[2]) < 100:
            fix = f'expected a metric and a width, as "rmse_m±1%"; metrics: {", ".join(known)}'
            raise UnusableInput(f'--until "{text}": {fix}')
        return cls(match[1], float(match[2]) / 100)

    def reached(self, results: Results, condition: Condition) -> bool:
        """Whether the interval is narrow enough for every tracker that has the metric, and one has it."""
        values = [results.at(self.metric, condition, tracker) for tracker in results.study.trackers]
        known = [v for v in values if np.isfinite(v.value)]
        return bool(known) and all(v.high - v.low <= 2 * self.half_width * abs(v.value) for v in known)


def run_study(
    study: Study, folder: Path, until: StopRule | None = None, advance: Advance = lambda *_: None,
    executor: Executor | None = None,
) -> Results:  # fmt: skip
    """Run the missing chunks of a study; its results. `until` is tested after 1, 2, 4, 8 … chunks of a condition.
    `executor`: default: threads. Raises UnusableInput for a folder of another study."""
    if not (folder / IDENTITY).exists():
        require_fitting_parts(study)
    store = ChunkStore(folder, study).open()
    if until is None:
        parts = [(condition.index, k) for condition in study.conditions for k in range(study.chunks)]
        run_missing(store, parts, advance, executor)
        return store.results({condition.index: study.runs for condition in study.conditions})
    return store.results({c.index: _run_until(store, c, until, advance, executor) for c in study.conditions})


def _run_until(
    store: ChunkStore, condition: Condition, until: StopRule, advance: Advance, executor: Executor | None
) -> int:
    """Run chunks of the condition until the rule holds or none is left; the number of runs."""
    study, enough, done = store.study, 1, 0
    while True:
        wanted = min(enough, study.chunks)
        run_missing(store, [(condition.index, k) for k in range(done, wanted)], advance, executor)
        runs, done = min(enough * study.chunk, study.runs), wanted
        if runs == study.runs or until.reached(store.results({condition.index: runs}), condition):
            advance(study.chunks - wanted)
            return runs
        enough *= 2


def run_missing(
    store: ChunkStore, parts: Sequence[Part], advance: Advance = lambda *_: None, executor: Executor | None = None
) -> None:
    """Run the chunks that are not in the store, on the executor or as many in parallel as the host allows."""
    study, missing = store.study, store.missing(parts)
    advance(len(parts) - len(missing))
    if not missing:
        return
    labels = [condition.label for condition in study.conditions]

    def each(part: Part, kept: object) -> None:
        advance(1, labels[part[0]])

    if executor is not None:
        if not study.declared_in:
            fix = "expected one loaded from a file, from which other processes build it"
            raise UnusableInput(f"study '{study.name}': built in memory; {fix}")
        declared = study.declared_in, study.runs, study.seed, digest_of(study)
        run(missing, functools.partial(_declared_chunk, *declared), store, executor, each)
        return
    keep()
    with Threads(jax.local_devices()[: max(1, len(missing) // CHUNKS_PER_DEVICE)]) as threads:
        run(missing, functools.partial(packed_chunk, study), store, threads, each)


def _declared_chunk(what: str, runs: int, seed: int, digest: str, part: Part) -> bytes:
    """In a worker: the content of a chunk's file, of a study by its name or file."""
    return packed_chunk(declared_again(what, runs, seed, digest), part)


def packed_chunk(study: Study, part: Part) -> bytes:
    """The content of a chunk's file: what `run_chunk` returns, and the computing time of all trackers, s."""
    index, chunk = part
    start, ids = time.perf_counter(), np.arange(chunk * study.chunk, (chunk + 1) * study.chunk)
    arrays = run_chunk(study, study.conditions[index], ids, first=chunk == 0)
    arrays[0]["seconds"] = np.array(time.perf_counter() - start)
    return packed(arrays)
