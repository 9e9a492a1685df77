"""Speed on one GPU and on all GPUs of this host: the beam tracker's likelihood and gradient, and a particle filter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from trackwright.experiments.lab.bench import particles
from trackwright.experiments.lab.bench.beam import TUNED, finished, simulate, trackers
from trackwright.experiments.lab.bench.timing import turns
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table
from trackwright.trackers.core.errors import UnusableInput
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

ROUNDS = 5
MEMORY_SHARE = 0.5
"""Share of a device's memory that recordings may take; results and temporaries need the rest."""


class Size(NamedTuple):
    """Sizes of the runs: beams in `parts` of `chunk` trajectories × `rows`, particle filters in parts of their own."""

    parts: int = 16
    chunk: int = 65_536
    rows: int = 200
    particle_trajectories: int = 16_384
    particle_chunk: int = 4096
    copied: int = 2**28


SMALL = Size(2, 8, 5, 8, 4, 1024)


def gpu(*, output: Output = DEFAULTS) -> int:
    """Speed on one GPU and on all GPUs of this host, beside reading the recordings once; they stay on the device.

    The likelihood of a beam tracker and its gradient over two tunables, beside the time that reading the recordings
    once takes at the bandwidth of the device's memory; and a particle filter on a line. 2 without a GPU.
    """
    if jax.default_backend() != "gpu":
        raise UnusableInput(
            f"bench: jax finds no GPU, only {jax.devices()[0].device_kind}; expected a CUDA device; install the extra "
            "on its host: pip install trackwright[cuda], or trackwright[cuda13] for drivers of CUDA 13"
        )
    devices = jax.local_devices()
    counts = sorted({1, len(devices)})
    rows = [
        row for count in counts for row in on(devices[:count], SMALL if output.small else Size(), output.rounds(ROUNDS))
    ]
    output.publish("bench gpu", Table(rows), device=devices[0].device_kind)
    return 0


def on(devices: Sequence[Any], size: Size, rounds: int) -> list[Row]:
    """Medians on these devices: the first, or all of the host."""

    def seconds(run: Callable[[], Any]) -> float:
        jax.block_until_ready(run())
        return float(np.median(turns([finished(run)], rounds)[:, 0, 0]))

    with jax.default_device(devices[0] if len(devices) == 1 else None):
        numbers = jax.device_put(jnp.zeros(size.copied, jnp.float32), devices[0])
        add: Any = jax.jit(lambda x: x + 1)
        speed = 2 * numbers.nbytes / seconds(lambda: add(numbers))
        batch = simulate(size.chunk, size.rows).batch
        batch_bytes = sum(x.nbytes for x in jax.tree_util.tree_leaves(batch))
        limit = (devices[0].memory_stats() or {}).get("bytes_limit")
        parts = size.parts if limit is None else max(1, min(size.parts, int(MEMORY_SHARE * limit / batch_bytes)))
        tracker = trackers()[1]
        parameters = select_parameters(tracker, TUNED)
        vector = flatten(parameters)
        problem = Problem(tracker, [batch] * parts, NegativeLogLikelihood(), parameters, size.chunk)
        runs = {"likelihood": lambda: problem.values(vector), "gradient": lambda: problem.evaluate(vector)[:2]}
        of_all = {"devices": len(devices), "GB/s each": speed / 1e9}
        rows = []
        for name, run in runs.items():
            took = seconds(run)
            rows.append({
                **of_all, "what": name, "trajectories": parts * size.chunk, "rows": size.rows, "run s": took,
                "times reading once": took / (parts * batch_bytes / (speed * len(devices))),
                "M rows/s": parts * size.chunk * size.rows / took / 1e6,
            })  # fmt: skip
        fixes, times, truth = particles.task(size.particle_trajectories)
        run = particles.ours(fixes, times, size.particle_chunk)
        error, took = particles.rmse(run(), truth), seconds(run)
        count, steps = fixes.shape[:2]
        what = f"filter of {particles.PARTICLES:,} particles"
        rows.append({**of_all, "what": what, "trajectories": count, "rows": steps, "run s": took,
                     "M rows/s": count * steps / took / 1e6, "error": error})  # fmt: skip
        return rows
