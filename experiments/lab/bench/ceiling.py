"""Shares of the parts of a step, by leaving them out: `python -m experiments.lab.bench.ceiling`.

The beam tracker with a given start, one chunk of 512 trajectories × 200 rows, and the particle filter on a line, with
the flags of the command line. A version without a part is no filter any more; versions take turns, and the least
processor time of each counts.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import Any
from unittest import mock

import numpy as np

from experiments.cli.runtime import set_flags
from experiments.lab.bench.timing import turns

ROWS, TRAJECTORIES, CLOUDS = 200, 512, 64
ROUNDS = 15


def main() -> int:
    """Measure and print both tables."""
    set_flags()
    print(table("beam tracker", beam(), TRAJECTORIES * ROWS))
    print(table("particle filter, 1,000 particles", particle_filter(), CLOUDS * ROWS))
    return 0


def table(title: str, seconds: Mapping[str, float], rows: int) -> str:
    """One line per version: million rows per processor second, and its time as a share of the first one's."""
    whole = next(iter(seconds.values()))
    lines = [
        f"{name:44s} {rows / s / 1e6:8.3f} M rows per processor second  {s / whole:5.2f}" for name, s in seconds.items()
    ]
    return "\n".join([title, *lines])


def least(runs: Sequence[Callable[[], Any]], rounds: int) -> list[float]:
    """The least processor seconds of each run, after a first one that compiles."""
    for run in runs:
        run()
    return [float(s) for s in turns(runs, rounds)[:, :, 1].min(axis=0)]


def beam() -> dict[str, float]:
    """Seconds of the beam tracker, and of versions without estimates, without track loss and without wraps."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    from experiments.lab.bench import measure
    from trackers.aoa import phases
    from trackers.core.algebra import total
    from trackers.core.chunks import CHUNK, as_dtype, chunks
    from trackers.core.tracker import filter_batch
    from trackers.core.tunable import freeze

    world = measure.simulate(TRAJECTORIES, ROWS)
    model: Any = as_dtype(measure.trackers()[1], np.float32)
    (part,) = chunks(world.batch, CHUNK)

    def alone(model: Any, batch: Any) -> Any:
        """Predictions and updates from the first row on."""
        tracker = freeze(model)
        filter_, motion, sensor = tracker.filter, tracker.motion, tracker.sensors["array"]

        def one(belief: Any, row: Any) -> Any:
            dt, reading, inputs = row
            return filter_.update(filter_.predict(belief, motion, inputs, dt), motion, sensor, reading, inputs)[0]

        def body(belief: Any, row: Any) -> Any:
            belief = jax.vmap(one, in_axes=-1, out_axes=-1)(belief, row)
            return belief, belief

        first = jax.tree_util.tree_map(lambda x: x[0], batch)
        start = jax.vmap(lambda r: tracker.start.belief(tracker.start.candidate({}, r), r), in_axes=-1, out_axes=-1)
        return jax.lax.scan(
            body, start(first._replace(key=first.dt)), (batch.dt, batch.readings["array"], batch.inputs)
        )

    def unwrapped(reading: Any, predicted: Any, sigma_p: Any) -> Any:
        """Centred differences of phases that do not wrap, with one common offset of zero."""
        seen = [jnp.where(s, 1.0, 0.0).astype(reading.values[0].dtype) for s in reading.seen]
        n = jnp.maximum(total(seen), 1.0)
        differences = [z - p for z, p in zip(reading.values, predicted, strict=True)]
        centre = total(s * d for s, d in zip(seen, differences, strict=True)) / n
        residuals = [s * (d - centre) for s, d in zip(seen, differences, strict=True)]
        return phases._scaled(residuals, n, n - 1.0, sigma_p, n < 0)

    def run(function: Any) -> Callable[[], Any]:
        compiled = eqx.filter_jit(function)
        return lambda: jax.block_until_ready(compiled(model, part))

    def without_wraps() -> Any:
        with mock.patch.object(phases, "centred", unwrapped):
            return unwrapped_run()

    unwrapped_run = run(lambda m, p: alone(m, p))
    versions = {
        "all": run(filter_batch),
        "likelihood alone, no estimates": run(lambda m, p: m.accumulate(p, lambda output, truth: (output.nis,))),
        "predict and update alone": run(alone),
        "… and no circular mean and wraps": without_wraps,
    }
    return dict(zip(versions, least(list(versions.values()), ROUNDS), strict=True))


def particle_filter() -> dict[str, float]:
    """Seconds of the particle filter, and of versions with numbers hardly random, without resampling, and both."""
    import jax
    import jax.numpy as jnp

    from experiments.lab.bench import particles
    from trackers.core.particle import filter as particle

    fixes, times, _ = particles.task(CLOUDS)

    def cheap(key: Any, rows: int, count: int, dtype: Any) -> Any:
        key, number = key + jnp.uint32(0x9E3779B9), jax.lax.broadcasted_iota(jnp.uint32, (count,), 0)
        bits = [((number + jnp.uint32(7919 * r)) * key[0] + key[1]) >> jnp.uint32(8) for r in range(rows)]
        return key, key[0].astype(dtype) * 2.0**-32, [(b.astype(dtype) * 2.0**-24 - 0.5) * 12**0.5 for b in bits]

    def always_enough(weights: Any) -> Any:
        return jnp.full_like(weights[..., 0], 1e9)

    versions: dict[str, dict[str, Any]] = {
        "all": {},
        "no random bits": {"draws": cheap},
        "no resampling": {"effective_sample_size": always_enough},
        "neither": {"draws": cheap, "effective_sample_size": always_enough},
    }
    found = {}
    for name, changes in versions.items():
        with ExitStack() as patches:
            for attribute, value in changes.items():
                patches.enter_context(mock.patch.object(particle, attribute, value))
            # One function, whose program depends on what is patched.
            jax.clear_caches()
            (found[name],) = least([particles.ours(fixes, times)], 3)
    return found


if __name__ == "__main__":
    sys.exit(main())
