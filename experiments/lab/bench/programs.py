"""Processor time per row of compiled programs: filter, smoother and gradient of each tracker by size of the batch."""

from collections.abc import Iterator
from functools import partial
from typing import Any, cast

import jax
import numpy as np

import trackwright as tw
from trackwright.experiments.lab.bench.timing import per_row
from trackwright.experiments.lab.runner import Case, Figures
from trackwright.sim import worlds
from trackwright.trackers.core.errors import UnusableInput
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

SIZES = (1, 64, 512)
LARGE = (512, 16_384)
"""Trajectories of a batch on a processor, and on a GPU."""

WORLDS = {
    "beam": "station",
    "direct": "station",
    "line-grid": "line",
    "line-pf": "line",
    "uwb": "ranges",
    "uwb-imu": "tool",
    "tdoa": "tdoa",
    "fusion": "fusion",
    "fix-kf": "agv",
    "imm": "agv",
    "mhk": "agv",
}
"""The world whose recordings a tracker reads."""

LARGE_STATES = ("line-grid", "line-pf", "mhk")
"""Trackers that run forward alone; of these 64 trajectories are the most on a processor."""

ON_GPU = ("beam", "uwb", "line-pf")
ROWS = 40
"""Times of each recording, or readings; `line` lasts for two minutes."""


def cases() -> Iterator[Case]:
    """Every tracker and size on the processor."""
    for tracker in WORLDS:
        for size in SIZES[: 2 if tracker in LARGE_STATES else None]:
            yield from of_size(tracker, size)


def gpu_cases() -> Iterator[Case]:
    """Some trackers in large batches on a GPU; raises UnusableInput without one."""
    if jax.default_backend() != "gpu":
        raise UnusableInput(
            f"gpu: jax finds no GPU, only {jax.devices()[0].device_kind}; expected a CUDA device; install the extra on "
            "its host: pip install trackwright[cuda], or trackwright[cuda13] for drivers of CUDA 13"
        )
    for tracker in ON_GPU:
        for size in LARGE:
            yield from of_size(tracker, size)


def of_size(tracker: str, size: int) -> Iterator[Case]:
    """Filter, smoother and gradient of a batch, as far as a tracker has them."""
    for what in ("filter",) if tracker in LARGE_STATES else ("filter", "smoother", "gradient"):
        measure = partial(figures, tracker, what, size)
        yield Case(WORLDS[tracker], tracker, f"{what}, {size} trajectories", measure)


def figures(name: str, what: str, size: int) -> Figures:
    """The time per row; a gradient is the likelihood's by the first two tunables."""
    options = {} if WORLDS[name] == "line" else {"rows": ROWS}
    folder = worlds.WORLDS[WORLDS[name]](np.arange(size), 0, **options)
    batch = tw.TRACKERS[name].batches([folder], name)[0]
    recordings, tracker = [t.recording for t in batch.trajectories], cast(Any, batch.tracker)
    rows, stacked = sum(map(len, recordings)), tw.stack(recordings)
    if what == "gradient":
        parameters = select_parameters(tracker, list(tw.tunables(tracker))[:2])
        problem, vector = Problem(tracker, [stacked], NegativeLogLikelihood(), parameters), flatten(parameters)
        return per_row(lambda: jax.block_until_ready(problem.evaluate(vector)[:2]), rows)
    run = tw.Smoothed(tracker) if what == "smoother" else tracker
    return per_row(lambda: run.run(stacked, chunk=max(512, size)), rows)
