"""Speed on one GPU and on all GPUs of this host: `make bench-gpu`, or `python -m experiments.lab.bench.gpu`.

The likelihood of a beam tracker and its gradient over two tunables, beside the time that reading the recordings once
takes at the bandwidth of the device's memory; and a particle filter on a line. The recordings stay on the device.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.cli.main import run_alone
from experiments.lab.bench import particles
from experiments.lab.bench.__main__ import machine
from experiments.lab.bench.measure import TUNED, packages, simulate, trackers
from experiments.lab.bench.timing import turns, write_json
from experiments.lab.bench.waiting import commit
from experiments.lab.subprocesses import REPOSITORY
from tuning.objectives import NegativeLogLikelihood
from tuning.parameters import flatten, select_parameters
from tuning.problem import Problem

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


def main(*, out: Path = Path("out/bench-gpu.json")) -> int:
    """Measure one GPU, and all of them where there are several, print a table and write the results; 2 without a GPU.

    Args:
        out: the JSON file to write.
    """
    if jax.default_backend() != "gpu":
        print(
            f"bench: jax finds no GPU, only {jax.devices()[0].device_kind}; expected a CUDA device; install the extra "
            "on its host: pip install trackwright[cuda]",
            file=sys.stderr,
        )
        return 2
    began, host, devices = datetime.now(UTC), machine(), jax.local_devices()
    counts = sorted({1, len(devices)})
    found = {f"{count}": measured(devices[:count], Size()) for count in counts}
    results = {
        "date": began.isoformat(timespec="seconds"),
        "command": ["python", "-m", "experiments.lab.bench.gpu"],
        "commit": commit(REPOSITORY),
        "machine": host,
        "device": devices[0].device_kind,
        "packages": packages(None),
        "devices": found,
    }
    write_json(out, results)
    print(f"{devices[0].device_kind}, jax {results['packages']['jax']}, medians of {ROUNDS} runs")
    for count, one in found.items():
        print(report(count, one))
    print(f"Written: {out}")
    return 0


def report(count: str, found: dict[str, Any]) -> str:
    """The results of some devices as text."""
    beam, particle = found["beam"], found["particles"]
    return "\n".join(
        [
            f"{count} device(s): {found['bandwidth_gb_per_s']:.0f} GB/s each",
            *(
                f"  {what:22s} {beam['trajectories']} × {beam['rows']}  {beam[f'{what}_s']:8.3f} s, "
                f"{beam[f'{what}_over_reading']:.1f} times reading the recordings once"
                for what in ("likelihood", "gradient")
            ),
            f"  particle filter        {particle['trajectories']} × {particle['rows']} × {particles.PARTICLES}  "
            f"{particle['run_s']:8.3f} s, {particle['million_steps_per_s']:.2f} million trajectory-steps/s",
        ]
    )


def measured(devices: Sequence[Any], size: Size) -> dict[str, Any]:
    """Times on these devices: the first, or all of the host."""
    with jax.default_device(devices[0] if len(devices) == 1 else None):
        speed = bandwidth(devices[0], size.copied)
        beam = beams(size, speed * len(devices), devices[0])
        return {"bandwidth_gb_per_s": speed / 1e9, "beam": beam, "particles": particle_filter(size)}


def bandwidth(device: Any, count: int) -> float:
    """Bytes a second that a device reads and writes, from a sum of `count` single-precision numbers and 1."""
    numbers = jax.device_put(jnp.zeros(count, jnp.float32), device)
    add = jax.jit(lambda x: x + 1)
    return 2 * numbers.nbytes / _median(lambda: add(numbers))


def beams(size: Size, speed: float, device: Any) -> dict[str, Any]:
    """Times of likelihood and gradient of the beam tracker; `speed`: of the memory of all devices, bytes a second."""
    batch = simulate(size.chunk, size.rows).batch
    one = sum(x.nbytes for x in jax.tree_util.tree_leaves(batch))
    limit = (device.memory_stats() or {}).get("bytes_limit")
    parts = size.parts if limit is None else max(1, min(size.parts, int(MEMORY_SHARE * limit / one)))
    tracker = trackers()[1]
    parameters = select_parameters(tracker, TUNED)
    vector = flatten(parameters)
    problem = Problem(tracker, [batch] * parts, NegativeLogLikelihood(), parameters, size.chunk)
    reading = parts * one / speed
    likelihood = _median(lambda: problem.values(vector))
    gradient = _median(lambda: problem.evaluate(vector)[:2])
    return {
        "trajectories": parts * size.chunk,
        "rows": size.rows,
        "recordings_bytes": parts * one,
        "likelihood_s": likelihood,
        "likelihood_over_reading": likelihood / reading,
        "gradient_s": gradient,
        "gradient_over_reading": gradient / reading,
    }


def particle_filter(size: Size) -> dict[str, Any]:
    """Time of the particle filter of `experiments.lab.bench.particles`, estimates copied to the host."""
    fixes, times, truth = particles.task(size.particle_trajectories)
    run = particles.ours(fixes, times, size.particle_chunk)
    error = particles.rmse(run(), truth)
    seconds = _median(run)
    count, rows = fixes.shape[:2]
    rate = count * rows / seconds / 1e6
    return {"trajectories": count, "rows": rows, "run_s": seconds, "million_steps_per_s": rate, "rmse_m": error}


def _median(run: Callable[[], Any]) -> float:
    """Median seconds of a run, after one that compiles."""

    def blocked() -> None:
        jax.block_until_ready(run())

    blocked()
    return float(np.median(turns([blocked], ROUNDS)[:, 0, 0]))


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.bench.gpu")
