"""The beam tracker and its fit beside a textbook version, dynamax, cuthbert and scipy, which take turns in one process.

All filter the same raw phases. The textbook has all wrapped phase differences (28 of 8 antennas), their singular
covariance with a jitter, a Cholesky factor and two solves per step, and the Joseph form: equations (5) to (17) of Will
et al. 2020 line by line. The libraries (extra: peers) are used as documented, on the same differences.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from trackwright.experiments.lab.bench.timing import Version, apart_each, clocked, compared, turns
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, shown
from trackwright.trackers.aoa.beam import Beam, beam_tracker
from trackwright.trackers.aoa.layout import DEFAULT_ANTENNAS, DEFAULT_WAVELENGTH
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.algebra import diagonal
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.core.model.sensor import Reading
from trackwright.trackers.core.model.start import AbstractStart
from trackwright.trackers.core.run.chunks import CHUNK, as_dtype, chunks, run_chunks
from trackwright.trackers.core.run.tracker import AbstractTracker, filter_batch
from trackwright.tuning.fitting import fit
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import flatten, select_parameters, with_parameters
from trackwright.tuning.problem import Problem

TRAJECTORIES, ROWS = 4096, 200
SLICES = {"textbook": (256, 50), "dynamax": (16, 50), "cuthbert": (256, 50)}
"""Trajectories and rows of those that are a hundred times slower; larger batches of dynamax deadlock on two cores."""

ROUNDS = 9
LIMIT_S = 150.0
"""Limit of one process: batched LAPACK calls, as textbook versions make them, can deadlock on two cores."""

TUNED = ("motion.sigma_a", "sensors.*.sigma_p")
SIGMA_A, SIGMA_P, STEP_S, MASKED = 0.5, 0.3, 0.01, 0.05
START_COV = np.diag(np.square([np.deg2rad(30.0), np.deg2rad(30.0), 1.0, 1.0]))
JITTER = 1e-3
"""Added to the variance of every difference, rad²; makes the Cholesky factor exist in single precision."""


def beam(*, peers: bool = False, output: Output = DEFAULTS) -> int:
    """Speed of the beam tracker beside a textbook version and other libraries.

    Each runs beside ours in a process of its own, in which both take turns: ratios, taken within a round, are more
    reliable than times. 1 if a process fails.

    Args:
        peers: also dynamax and cuthbert (extra: peers).
    """
    others = ("textbook", *(("dynamax", "cuthbert") if peers else ()))
    rows = apart_each("bench.beam:beside", others, output.small, LIMIT_S)
    output.publish("bench beam", Table(rows, note="Errors: RMS of the last azimuth, degrees."))
    return int(any("failed" in row for row in rows))


def beside(other: str, small: bool) -> Row:
    """Medians of ours and another version, which take turns; beside the textbook also our own start and gradient."""
    size = (16, 20) if small else (TRAJECTORIES, ROWS)
    world = simulate(*size)
    self_starting, given = trackers()

    def error(result: Any) -> float:
        """RMS of the last azimuths: of chunks of estimates, or of a tuple that begins with means."""
        if isinstance(result, tuple):
            azimuths, rows = np.asarray(result[0])[:, -1, 0], np.asarray(result[0]).shape[1]
        else:
            azimuths, rows = np.concatenate([np.asarray(part.mean.azimuth[-1]) for part in result]), size[1]
        return float(np.rad2deg(np.sqrt(np.mean((azimuths - world.angles[rows - 1, 0, : len(azimuths)]) ** 2))))

    versions = {"ours": Version(*size, finished(filtering(given, world.batch)), error)}
    if other == "textbook":
        parameters = select_parameters(given, TUNED)
        problem, vector = Problem(given, [world.batch], NegativeLogLikelihood(), parameters, CHUNK), flatten(parameters)
        versions["ours, start included"] = Version(*size, finished(filtering(self_starting, world.batch)), error)
        versions["ours, gradient of two"] = Version(*size, finished(lambda: problem.evaluate(vector)[:2]))
    few = min(SLICES[other][0], size[0]), min(SLICES[other][1], size[1])
    run, part = VERSIONS[other](), world.part(*few)
    versions[other] = Version(*few, finished(lambda: run(*part)), error)
    return {"rows": compared(versions, 1 if small else ROUNDS)}


class GivenStart(AbstractStart):
    """Start at the first row from the angles in the recording's inputs, without a search."""

    def can_start(self, row: Any) -> Any:
        return row.valid

    def candidate(self, sensors: Any, row: Any) -> Any:
        return jnp.stack([row.inputs["azimuth"], row.inputs["elevation"]])

    def belief(self, candidate: Any, row: Any) -> Gaussian:
        zero = jnp.zeros_like(candidate[0])
        return Gaussian(Beam(candidate[0], candidate[1], zero, zero), diagonal(list(np.diag(START_COV)), zero))


class World(NamedTuple):
    """Raw phases of beams that move by the tracker's own model; `angles` (T, 2, B), rad, are the truth."""

    batch: Batch
    angles: np.ndarray

    def part(self, trajectories: int, rows: int) -> tuple[np.ndarray, ...]:
        """Input of the other versions, batch first: phases, mask, dt, and mean and covariance of the first row."""
        cut = jax.tree_util.tree_map(lambda x: np.moveaxis(x[:rows, ..., :trajectories], -1, 0), self.batch)
        first = np.moveaxis(self.angles[0, :, :trajectories], -1, 0)
        mean = np.concatenate([first, np.zeros_like(first)], axis=1).astype(np.float32)
        reading = cut.readings["array"]
        return reading.values, reading.seen, cut.dt, mean, np.tile(START_COV.astype(np.float32), (trajectories, 1, 1))


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


def trackers() -> tuple[AbstractTracker, AbstractTracker]:
    """The beam tracker with its own start by delay-and-sum, and the same one with a given start."""
    station = Station(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), DEFAULT_ANTENNAS, DEFAULT_WAVELENGTH)
    tracker = beam_tracker(station, "array", SIGMA_A, SIGMA_P)
    return tracker, eqx.tree_at(lambda t: t.start, tracker, GivenStart())


def filtering(tracker: Any, batch: Batch, chunk: int = CHUNK) -> Callable[[], Any]:
    """A run of the tracker over a batch."""
    model = as_dtype(tracker, batch.dt.dtype)
    return lambda: run_chunks(filter_batch, [(model, part) for part in chunks(batch, chunk)])


def finished(run: Callable[[], Any]) -> Callable[[], Any]:
    """The run, until its computation is finished."""
    return lambda: jax.block_until_ready(run())


def version(name: str, trajectories: int, rows: int) -> tuple[Callable[[], Any], int]:
    """A run of one version, with a given start, and its number of rows."""
    world = simulate(trajectories, rows)
    if name == "ours":
        return filtering(trackers()[1], world.batch), trajectories * rows
    run, part = VERSIONS[name](), world.part(trajectories, rows)
    return finished(lambda: run(*part)), trajectories * rows


_FIRST, _SECOND = np.triu_indices(len(DEFAULT_ANTENNAS), 1)
TAKE = (np.eye(len(DEFAULT_ANTENNAS))[_FIRST] - np.eye(len(DEFAULT_ANTENNAS))[_SECOND]).astype(np.float32)
"""Forms the differences of all pairs of antennas, (m, n)."""

WAVENUMBERS = (2 * np.pi / DEFAULT_WAVELENGTH * TAKE @ DEFAULT_ANTENNAS).astype(np.float32)
"""Predict the differences from a direction, (m, 2), rad."""


def wrap(angle: Any) -> Any:
    """The angle wrapped to [−π, π], rad."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def transition(dt: Any) -> tuple[Any, Any]:
    """F of equation (5) and G (4, 2), the effect of accelerations; state: azimuth, elevation and their rates."""
    eye = jnp.eye(2, dtype=jnp.float32)
    return jnp.block([[eye, dt * eye], [0 * eye, eye]]), jnp.concatenate([0.5 * dt * dt * eye, dt * eye])


def predicted(x: Any) -> Any:
    """Predicted differences (m,), rad, equation (9), not wrapped."""
    direction = jnp.stack([jnp.sin(x[0]) * jnp.cos(x[1]), jnp.sin(x[1])])
    return jnp.asarray(WAVENUMBERS) @ direction


def both_seen(seen: Any) -> Any:
    """Mask (m,) of the pairs with both antennas seen."""
    return jnp.abs(jnp.asarray(TAKE)) @ (1.0 - seen.astype(jnp.float32)) < 0.5


def full_noise(sigma_p: Any = SIGMA_P) -> Any:
    """The covariance (m, m), rad², of the differences of antennas that are all seen."""
    return sigma_p**2 * TAKE @ TAKE.T + JITTER * np.eye(len(TAKE))


def noise_of(usable: Any, full: Any) -> Any:
    """Covariance of the differences; unusable pairs have unit variance and no correlation."""
    return jnp.where(usable[:, None] & usable[None], full.astype(np.float32), jnp.diag(jnp.where(usable, 0.0, 1.0)))


def textbook() -> Callable[..., Any]:
    """The filter of a batch of trajectories: phases (B, T, n), seen (B, T, n), dt (B, T), mean (B, 4), cov (B, 4, 4).

    Returns mean, covariance, NIS and log-likelihood of every row.
    """

    def step(carry: Any, row: Any) -> tuple[Any, Any]:
        (x, P), (phases, seen, dt) = carry, row
        F, G = transition(dt)
        x, P = F @ x, F @ P @ F.T + SIGMA_A**2 * G @ G.T
        usable = both_seen(seen)
        H = jnp.where(usable[:, None], jax.jacfwd(predicted)(x), 0.0)
        innovation = jnp.where(usable, wrap(jnp.asarray(TAKE) @ phases - predicted(x)), 0.0)
        R = noise_of(usable, full_noise())
        factor = jax.scipy.linalg.cho_factor(H @ P @ H.T + R)
        K = jax.scipy.linalg.cho_solve(factor, H @ P).T
        x = x + K @ innovation
        rest = jnp.eye(4, dtype=jnp.float32) - K @ H
        P = rest @ P @ rest.T + K @ R @ K.T
        nis = innovation @ jax.scipy.linalg.cho_solve(factor, innovation)
        log_determinant = 2.0 * jnp.sum(jnp.log(jnp.diag(factor[0])))
        density = -0.5 * (nis + log_determinant + jnp.sum(usable) * jnp.log(2 * jnp.pi))
        return (x, P), (x, P, nis, density)

    return jax.jit(jax.vmap(lambda phases, seen, dt, mean, cov: jax.lax.scan(step, (mean, cov), (phases, seen, dt))[1]))


def with_dynamax(sigma_a: Any = SIGMA_A, sigma_p: Any = SIGMA_P) -> Callable[..., Any]:
    """dynamax's `extended_kalman_filter` under `vmap`; wraps and masks are inputs of the emission function.

    Returns means, covariances and log-likelihoods.
    """
    from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter

    def one(phases: Any, seen: Any, dt: Any, mean: Any, cov: Any) -> Any:
        differences = phases @ jnp.asarray(TAKE).T
        usable = jax.vmap(both_seen)(seen)
        F, G = transition(dt[-1])

        def emission(x: Any, inputs: Any) -> Any:
            read, use = inputs[: len(TAKE)], inputs[len(TAKE) :]
            return read - use * wrap(read - predicted(x))

        parameters = ParamsNLGSSM(
            initial_mean=mean,
            initial_covariance=cov,
            dynamics_function=lambda x, inputs: F @ x,
            dynamics_covariance=sigma_a**2 * G @ G.T,
            emission_function=emission,
            emission_covariance=jax.vmap(lambda u: noise_of(u, full_noise(sigma_p)))(usable),
        )
        inputs = jnp.concatenate([differences, usable.astype(jnp.float32)], axis=1)
        posterior = extended_kalman_filter(parameters, differences, inputs)
        return posterior.filtered_means, posterior.filtered_covariances, posterior.marginal_loglik

    return jax.jit(jax.vmap(one))


def with_cuthbert() -> Callable[..., Any]:
    """cuthbert's moment-linearising filter in square-root form, under `vmap`; NaN marks masked differences."""
    import cuthbert
    from cuthbert.gaussian import moments

    root = jnp.asarray(np.linalg.cholesky(full_noise()), jnp.float32)

    def one(phases: Any, seen: Any, dt: Any, mean: Any, cov: Any) -> Any:
        F, G = transition(dt[-1])
        noise_root = jnp.concatenate([SIGMA_A * G, jnp.zeros((4, 2), jnp.float32)], axis=1)

        def dynamics(state: Any, inputs: Any) -> Any:
            return (lambda x: (F @ x, noise_root)), state.mean

        def observation(state: Any, inputs: Any) -> Any:
            phases, seen = inputs
            expected = predicted(state.mean)
            read = jnp.where(both_seen(seen), expected + wrap(jnp.asarray(TAKE) @ phases - expected), jnp.nan)
            return (lambda x: (predicted(x), root)), state.mean, read

        kalman = moments.build_filter(mean, jnp.linalg.cholesky(cov), dynamics, observation)
        states = cuthbert.filter(kalman, (phases, seen), kalman.init_prepare())
        return states.mean[1:], states.chol_cov[1:], states.log_normalizing_constant

    return jax.jit(jax.vmap(one))


VERSIONS: dict[str, Callable[[], Callable[..., Any]]] = {
    "textbook": textbook,
    "dynamax": with_dynamax,
    "cuthbert": with_cuthbert,
}

FIT_LIMIT_S = 5.0
"""Limit of the time of a compiled fit."""

CORNERS = ((10.0, 10.0), (0.1, 0.1), (10.0, 0.1), (0.1, 10.0))
DYNAMAX_SLICE, DYNAMAX_STEPS = (16, 50), 20


def tuning(*, peers: bool = False, output: Output = DEFAULTS) -> int:
    """Computing time of a fit of σ_a and σ_p of the beam tracker, from starts wrong by a factor of ten.

    4,096 trajectories of 200 rows, after a fit that compiles. Beside it, in the same process, scipy's L-BFGS-B on
    finite differences of the same jitted objective, and a gradient of the likelihood of dynamax's filter, on a small
    slice because larger batches of its solves deadlock. 1 if a fit takes too long.

    Args:
        peers: also dynamax (extra: peers).
    """
    size = (16, 20) if output.small else (TRAJECTORIES, ROWS)
    world, corners = simulate(*size), CORNERS[:1] if output.small else CORNERS
    versions: dict[str, Callable[[World], Callable[[Any], Row]]] = {
        "tuning.fit": with_fit,
        "scipy L-BFGS-B": with_scipy,
    }
    rows = shown(row for name, build in versions.items() for row in of_fits(name, build(world), corners))
    slowest = max(row["seconds"] for row in rows if row["version"] == "tuning.fit")
    tables = [Table(rows, "fits", f"The slowest of {len(corners)} fits took {slowest:.2f} s; limit {FIT_LIMIT_S:g} s.")]
    if peers:
        seconds, share = dynamax_gradient(world), world.angles[:, 0].size / np.prod(DYNAMAX_SLICE)
        tables.append(
            Table([{"of a slice, s": seconds, "of all, s": seconds * share}], "a gradient of dynamax's likelihood")
        )
    output.publish("bench tuning", *tables)
    return int(slowest > FIT_LIMIT_S)


def of_fits(name: str, run: Callable[[Any], Row], corners: Any) -> Iterator[Row]:
    """Timed fits from every start, after one that compiles."""
    (first, _), _ = clocked(lambda: run(corners[0]))
    for corner in corners:
        (seconds, processor), result = clocked(partial(run, corner))
        times = {"first call s": first, "seconds": seconds, "processor s": processor}
        yield {"version": name, "wrong by": str(corner), **times, **result}


def wrong(corner: Any) -> Any:
    """The benchmark's tracker with both noise levels multiplied by these factors."""
    tracker = trackers()[1]
    parameters = select_parameters(tracker, TUNED)
    return with_parameters(tracker, parameters, flatten(parameters) + np.log(corner))


def with_fit(world: World) -> Callable[[Any], Row]:
    """Fits by `tuning.fit`."""

    def run(corner: Any) -> Row:
        result = fit(wrong(corner), world.batch, NegativeLogLikelihood(), TUNED)
        evaluations = result.filter_runs / world.angles.shape[2]
        values = {name: float(x) for name, x in result.values.items()}
        errors = {f"{name}, standard error": float(x) for name, x in result.standard_errors.items()}
        return {"evaluations": evaluations, "value": result.value, **values, **errors}

    return run


def with_scipy(world: World) -> Callable[[Any], Row]:
    """Fits by scipy's L-BFGS-B with finite differences; their step suits single precision."""
    tracker = trackers()[1]
    parameters = select_parameters(tracker, TUNED)
    problem = Problem(tracker, [world.batch], NegativeLogLikelihood(), parameters)

    def run(corner: Any) -> Row:
        start = flatten(parameters) + np.log(corner)
        optimum = minimize(lambda v: float(problem.values(v)[0]), start, method="L-BFGS-B", options={"eps": 1e-3})
        return {"evaluations": float(optimum.nfev), "value": float(optimum.fun)}

    return run


def dynamax_gradient(world: World) -> float:
    """Seconds of the gradient of the negative log-likelihood of dynamax's filter on a slice: median of warm calls."""
    part = world.part(*DYNAMAX_SLICE)

    def objective(v: Any) -> Any:
        levels: Any = jnp.exp(v)
        return -jnp.mean(with_dynamax(levels[0], levels[1])(*part)[2]) / part[0].shape[1]

    gradient, at = jax.jit(jax.value_and_grad(objective)), jnp.log(jnp.array([10 * SIGMA_A, 10 * SIGMA_P], jnp.float32))
    jax.block_until_ready(gradient(at))
    return float(np.median(turns([lambda: jax.block_until_ready(gradient(at))], DYNAMAX_STEPS)[:, 0, 0]))
