"""One setting of the benchmark: the beam tracker and its competitors, taking turns in one process."""

from __future__ import annotations

import resource
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from experiments.lab.bench.textbook import all_pairs, textbook
from experiments.lab.bench.timing import clocked
from trackers.aoa.beam import Beam, beam_tracker
from trackers.aoa.layout import DEFAULT_ANTENNAS, DEFAULT_WAVELENGTH
from trackers.core.algebra import diagonal
from trackers.core.chunks import CHUNK, as_dtype, chunks, jitted, run_chunks
from trackers.core.filter import Gaussian
from trackers.core.recording import Batch
from trackers.core.rig import Station
from trackers.core.sensor import Reading
from trackers.core.start import AbstractStart
from trackers.core.tracker import AbstractTracker, filter_batch
from tuning.objectives import NegativeLogLikelihood
from tuning.parameters import flatten, select_parameters
from tuning.point import term_sums
from tuning.problem import Problem

TRAJECTORIES, ROWS = 4096, 200
SLICE = (256, 50)
"""Trajectories and rows for versions that are a hundred times slower."""

PEER_SLICES = {"dynamax": (16, 50), "cuthbert": (256, 50), "filterpy": (8, 50)}
"""Larger batches of dynamax's 28-dimensional solves deadlock on two cores (jaxlib 0.10); smaller ones run as fast."""

ROUNDS = 9
MEMORY_TRAJECTORIES, MEMORY_ROWS = 64, (200, 20_000)
TUNED = ("motion.sigma_a", "sensors.*.sigma_p")
SIGMA_A, SIGMA_P, STEP_S = 0.5, 0.3, 0.01
SIGMA_ANGLE, SIGMA_RATE = np.deg2rad(30.0), 1.0
MASKED = 0.05


class GivenStart(AbstractStart):
    """Start at the first row from the angles in the recording's inputs, without a search."""

    def can_start(self, row: Any) -> Any:
        return row.valid

    def candidate(self, sensors: Any, row: Any) -> Any:
        return jnp.stack([row.inputs["azimuth"], row.inputs["elevation"]])

    def belief(self, candidate: Any, row: Any) -> Gaussian:
        zero = jnp.zeros_like(candidate[0])
        cov = diagonal([SIGMA_ANGLE**2, SIGMA_ANGLE**2, SIGMA_RATE**2, SIGMA_RATE**2], zero)
        return Gaussian(Beam(candidate[0], candidate[1], zero, zero), cov)


class World(NamedTuple):
    """Raw phases of beams that move by the tracker's own model; `angles` (T, 2, B), rad, are the truth."""

    batch: Batch
    angles: np.ndarray

    def part(self, trajectories: int, rows: int) -> tuple[np.ndarray, ...]:
        """Input of the other libraries, batch first: phases, mask, dt, and mean and covariance of the first row."""
        cut = jax.tree_util.tree_map(lambda x: np.moveaxis(x[:rows, ..., :trajectories], -1, 0), self.batch)
        first = np.moveaxis(self.angles[0, :, :trajectories], -1, 0)
        mean = np.concatenate([first, np.zeros_like(first)], axis=1).astype(np.float32)
        cov = np.diag([SIGMA_ANGLE**2, SIGMA_ANGLE**2, SIGMA_RATE**2, SIGMA_RATE**2]).astype(np.float32)
        reading = cut.readings["array"]
        return reading.values, reading.seen, cut.dt, mean, np.tile(cov, (trajectories, 1, 1))


def simulate(trajectories: int, rows: int) -> World:
    """The benchmark's world, seeded: wrapped phases with common offsets, 5 % of them masked."""
    random = np.random.default_rng(20)
    shape = (rows, 2, trajectories)
    kicks = SIGMA_A * random.normal(size=shape) * STEP_S
    rates = random.uniform(-0.2, 0.2, shape[1:]) + np.cumsum(kicks, axis=0)
    angles = random.uniform(-0.3, 0.3, shape[1:]) + np.cumsum((rates - 0.5 * kicks) * STEP_S, axis=0)
    x, y = np.sin(angles[:, 0]) * np.cos(angles[:, 1]), np.sin(angles[:, 1])
    wavenumbers = 2 * np.pi / DEFAULT_WAVELENGTH * DEFAULT_ANTENNAS
    phases = wavenumbers[:, :1] * x[:, None] + wavenumbers[:, 1:] * y[:, None]
    noise = SIGMA_P * random.normal(size=phases.shape)
    phases = phases + noise + random.uniform(-np.pi, np.pi, (rows, 1, trajectories))
    phases = ((phases + np.pi) % (2 * np.pi) - np.pi).astype(np.float32)
    seen = random.uniform(size=phases.shape) > MASKED
    dt = np.full((rows, trajectories), STEP_S, np.float32)
    dt[0] = 0.0
    batch = Batch(
        dt=dt,
        valid=np.ones(dt.shape, bool),
        readings={"array": Reading(phases, seen, np.zeros((rows, 0, trajectories), np.float32))},
        inputs={name: angles[:, k].astype(np.float32) for k, name in enumerate(("azimuth", "elevation"))},
        truth={},
        key=np.zeros((2, trajectories), np.uint32),
    )
    return World(batch, angles)


@dataclass
class Version:
    """A competitor: `run` filters once; `azimuth` takes the last azimuths (B,), rad, from its result."""

    name: str
    trajectories: int
    rows: int
    run: Callable[[], Any]
    azimuth: Callable[[Any], np.ndarray] | None = None
    first_s: float = 0.0
    error_deg: float | None = None

    def timed(self) -> tuple[tuple[float, float], Any]:
        """Seconds and processor seconds of one run, and its result."""
        return clocked(lambda: jax.block_until_ready(self.run()))


def trackers() -> tuple[AbstractTracker, AbstractTracker]:
    """The beam tracker with its own start by delay-and-sum, and the same one with a given start."""
    station = Station(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), DEFAULT_ANTENNAS, DEFAULT_WAVELENGTH)
    own = beam_tracker(station, "array", SIGMA_A, SIGMA_P)
    return own, eqx.tree_at(lambda t: t.start, own, GivenStart())


def versions(world: World, peer: str | None) -> list[Version]:
    """All versions that take turns; first ours with a given start."""
    own, given = trackers()
    pairs = all_pairs(DEFAULT_ANTENNAS, DEFAULT_WAVELENGTH)

    def ours(tracker: AbstractTracker) -> Any:
        model = as_dtype(tracker, world.batch.dt.dtype)
        return lambda: run_chunks(filter_batch, [(model, part) for part in chunks(world.batch, CHUNK)])

    def last(parts: Any) -> np.ndarray:
        return np.concatenate([np.asarray(part.mean.azimuth[-1]) for part in parts])

    def first_of_tuple(result: Any) -> np.ndarray:
        return np.asarray(result[0])[:, -1, 0]

    def other(name: str, build: Any, trajectories: int, rows: int) -> Version:
        run, part = build(pairs, SIGMA_A, SIGMA_P), world.part(trajectories, rows)
        return Version(name, trajectories, rows, lambda: run(*part), first_of_tuple)

    parameters = select_parameters(given, TUNED)
    problem, vector = Problem(given, [world.batch], NegativeLogLikelihood(), parameters, CHUNK), flatten(parameters)
    first = Version("ours", TRAJECTORIES, ROWS, ours(given), last)
    if peer:
        from experiments.lab.bench import peers

        return [first, other(peer, getattr(peers, f"with_{peer}"), *PEER_SLICES[peer])]
    return [
        first,
        Version("ours, start included", TRAJECTORIES, ROWS, ours(own), last),
        Version("ours, gradient", TRAJECTORIES, ROWS, lambda: problem.evaluate(vector)[:2]),
        other("textbook", textbook, *SLICE),
    ]


def measure(peer: str | None = None) -> dict[str, Any]:
    """Compile and run times of every version: medians over rounds in which each has one turn."""
    world = simulate(TRAJECTORIES, ROWS)
    competitors = versions(world, peer)
    for competitor in competitors:
        (competitor.first_s, _), result = competitor.timed()
        if competitor.azimuth is not None:
            truth = world.angles[competitor.rows - 1, 0, : competitor.trajectories]
            competitor.error_deg = float(np.rad2deg(np.sqrt(np.mean((competitor.azimuth(result) - truth) ** 2))))
        del result
    seconds = np.array([[competitor.timed()[0] for competitor in competitors] for _ in range(ROUNDS)])
    return {"versions": summarised(competitors, seconds), "packages": packages(peer)}


def summarised(competitors: list[Version], seconds: np.ndarray) -> dict[str, dict[str, Any]]:
    """Results by the version's name; `seconds` (rounds, versions, 2): wall and processor time.

    Ratios are taken within a round, then their median over rounds.
    """
    steps = np.array([c.trajectories * c.rows for c in competitors])
    rates = steps[:, None] / seconds
    faster = np.median(rates[:, :1] / rates, axis=0)
    found = {}
    for k, competitor in enumerate(competitors):
        median, median_cpu = np.median(seconds[:, k], axis=0)
        found[competitor.name] = {
            "trajectories": competitor.trajectories,
            "rows": competitor.rows,
            "compile_s": max(competitor.first_s - median, 0.0),
            "run_ms": 1e3 * median,
            "cpu_ms": 1e3 * median_cpu,
            "run_ms_each_round": 1e3 * seconds[:, k, 0],
            "million_steps_per_s": np.median(rates[:, k, 0]) / 1e6,
            "ours_is_faster_by": faster[k, 0],
            "ours_is_faster_by_per_cpu_second": faster[k, 1],
            "azimuth_error_deg": competitor.error_deg,
        }
    return found


def memory() -> dict[str, Any]:
    """Memory, bytes, of the gradient of two tunables for few and for many rows; needs its own process.

    `temporaries`: of the compiled program, beside inputs and outputs. `peak`: of the process, inputs and compiler
    included; it never decreases, so that few rows come first.
    """
    _, given = trackers()
    parameters = select_parameters(given, TUNED)
    compiled: Any = jitted
    found: dict[str, Any] = {"trajectories": MEMORY_TRAJECTORIES, "temporaries": {}, "inputs": {}, "peak": {}}
    few = simulate(MEMORY_TRAJECTORIES, MEMORY_ROWS[0]).batch
    for rows in MEMORY_ROWS:
        times = rows // len(few.dt)
        batch = jax.tree_util.tree_map(lambda x, times=times: np.concatenate([x] * times), few)._replace(key=few.key)
        problem = Problem(given, [batch], NegativeLogLikelihood(), parameters, CHUNK)
        (part,) = chunks(batch, CHUNK)
        arguments = term_sums, problem.point(flatten(parameters)), part
        program = compiled.lower(*arguments).compile()
        jax.block_until_ready(program(*arguments))
        found["temporaries"][str(rows)] = program.compiled.memory_analysis().temp_size_in_bytes
        found["inputs"][str(rows)] = sum(x.nbytes for x in jax.tree_util.tree_leaves(batch))
        found["peak"][str(rows)] = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return found


def packages(peer: str | None) -> dict[str, str]:
    """Versions of the packages used."""
    return {name: version(name) for name in ("jax", "jaxlib", "numpy", *([peer] if peer else []))}
