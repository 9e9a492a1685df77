"""The contract of a tracker: identities, derivatives, likelihood, consistency and speed."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import equinox as eqx
import jax
import numpy as np

from trackwright.trackers.conformance.contract import BrokenContract, Check, NotApplicable, Report, report, require_part
from trackwright.trackers.conformance.dense import Conditioned, conditioned
from trackwright.trackers.conformance.identities import identity_checks
from trackwright.trackers.conformance.ran import FEWEST, Ran
from trackwright.trackers.conformance.sums import Sums
from trackwright.trackers.conformance.worlds import World, drawn_world, own_recordings
from trackwright.trackers.core.data.consistency import nees
from trackwright.trackers.core.data.estimates import Estimates
from trackwright.trackers.core.data.recording import Recording, each_array, stack
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.state import component_names, coordinates
from trackwright.trackers.core.run.chunks import as_dtype
from trackwright.trackers.core.run.tracker import AbstractTracker, filter_batch

TOGETHER = 8
"""Recordings of a world that run together."""

WORLD = 128
"""Recordings of the world on which consistency is judged: its mean NEES has a standard deviation of 9 % for a plane."""

SLACK = 1.5
"""Factor by which the mean NEES may differ from its expectation: filters of nonlinear models are not exact."""

SLACK_STUDENT_T = 2.0
"""That factor where readings have the noise of Student's t, which a Kalman filter approximates by reweighting."""

TOO_SMALL = (
    "the filter adds all noise of the motion and of the residual, counts no reading twice and has enough particles, or "
    "is a ParticleFilter where `step` or `measure` bends within the uncertainty"
)
TOO_LARGE = "the filter adds the noise of the motion and of the residual once, and uses every reading that is seen"
"""The usual fixes of covariances in a world with the tracker's own model and noise levels."""

LENGTHS, GROWTH = (64, 512), 1.2
"""Rows of two programs, and the factor by which the numbers that one row computes may grow."""


def check_tracker(
    tracker: AbstractTracker, recordings: Sequence[Recording] | None = None, *, causal: bool = True, seed: int = 0
) -> Report:
    """What `tracker_checks` find."""
    return report(tracker_checks(tracker, recordings, causal=causal, seed=seed))


def tracker_checks(
    tracker: AbstractTracker, recordings: Sequence[Recording] | None = None, *, causal: bool = True, seed: int = 0
) -> list[Check]:
    """The checks of a tracker on recordings that it follows, of which the first 64 rows are used.

    `recordings`: by default drawn from the tracker's own motion and sensors, where these read no inputs. `causal`:
    False for a smoother, whose estimates depend on later rows. No bit of an estimate depends on padding, later rows,
    other trajectories, values that are not seen, or a cut after which `initial` continues; `accumulate` agrees with
    `scan`; derivatives are difference quotients; a linear tracker has the likelihood and the moments of conditioning;
    covariances are consistent with the errors in a world drawn from its own model; time is linear in rows. Raises
    UnusableInput for an object of another kind, and where recordings are needed and missing.
    """
    require_part("check_tracker", tracker)
    given = own_recordings(tracker, FEWEST, seed) if recordings is None else list(recordings)
    ran = Ran(tracker, given)
    identities = identity_checks(ran, causal)
    begun = identities[0]

    @cache
    def sums() -> Sums:
        with jax.enable_x64(True):
            return Sums(tracker, ran)

    @cache
    def world() -> World:
        with jax.enable_x64(True):
            return drawn_world(tracker, ran.recordings[-1], ran.estimates[len(ran.recordings) - 1], WORLD, seed)

    @cache
    def in_world() -> Estimates:
        with jax.enable_x64(True):
            return world().tracker.run(world().recordings, TOGETHER, initial=world().prior)

    def check_conditioning() -> str:
        filter_ = world().tracker.filter
        if not isinstance(filter_.init(world().prior, np.zeros(2, np.uint32)), Gaussian):
            raise NotApplicable(f"the belief of a {type(filter_).__name__} is not normal")
        with jax.enable_x64(True):
            expected = conditioned(world(), 0)
            _compare_conditioned(world(), in_world(), expected)
        return "likelihood, mean and covariance are those of the joint distribution"

    return [
        *identities,
        Check("single and batch", lambda: sums().compare_alone(), begun),
        Check("accumulate", lambda: sums().compare_sums(), begun),
        Check("gradient", lambda: sums().compare_slopes(), begun),
        Check("conditioning", check_conditioning, begun),
        Check("consistency", lambda: _check_consistency(world(), in_world()), begun),
        Check("speed", partial(_check_speed, tracker, max(given, key=len)), begun),
    ]


def _compare_conditioned(world: World, estimates: Estimates, expected: Conditioned) -> None:
    last, names = len(world.recordings[0]) - 1, component_names(world.prior.mean)
    mean = np.array([float(x) for x in coordinates(jax.tree_util.tree_map(lambda x: x[0, last], estimates.mean))[0]])
    cov, sigmas = np.asarray(estimates.covariance)[0, last], np.sqrt(np.diagonal(expected.cov))
    spread = np.abs(cov - expected.cov) / np.outer(sigmas, sigmas)
    if not spread.max() <= 1e-5:
        i, j = np.unravel_index(int(np.argmax(spread)), spread.shape)
        raise BrokenContract(
            f"the last covariance of {names[i]} and {names[j]} is {cov[i, j]:.6g}, given all readings "
            f"{expected.cov[i, j]:.6g}; usual fix: the covariance after an update is (I − K H) P, after a step "
            "F P Fᵀ + G Gᵀ"
        )
    off = np.abs(mean - expected.mean) / sigmas
    if not off.max() <= 1e-5:
        raise BrokenContract(
            f"the last estimate of {names[int(off.argmax())]} is off the mean given all readings by {off.max():.3g} "
            "standard deviations; usual fix: the gain is P Hᵀ S⁻¹, and the mean moves by it times the innovation"
        )
    mine = float(np.sum(estimates.log_likelihood[0]))
    if not abs(mine - expected.log_likelihood) <= 1e-6 * abs(expected.log_likelihood) + 1e-6:
        n_seen = sum(int(np.sum(r.seen)) for r in world.recordings[0].readings.values())
        raise BrokenContract(
            f"the log-likelihood is {mine:.8g}, that of the joint normal distribution of all readings "
            f"{expected.log_likelihood:.8g}, off by {(mine - expected.log_likelihood) / n_seen:.3g} for each number; "
            "usual fix: log_scale is −½ log 2π − log sigma for each channel seen, of the sigma that whitens"
        )


def _check_consistency(world: World, estimates: Estimates) -> str:
    last = len(world.recordings[0]) - 1
    with jax.enable_x64(True):
        errors = world.errors(estimates.mean, last)
    values, d = nees(errors, np.asarray(estimates.covariance)[:, last]), errors.shape[1]
    ratio = float(np.mean(values)) / d
    words = f"the mean NEES of {len(values)} tracks of a world drawn from the model is {ratio:.2f} for each component"
    slack = SLACK if world.normal else SLACK_STUDENT_T
    if not 1 / slack < ratio < slack:
        raise BrokenContract(
            f"{words}, expected 1 within a factor {slack:g}: covariances are too {'small' if ratio > 1 else 'large'}, "
            f"whatever the noise levels, which the world shares; usual fix: {TOO_SMALL if ratio > 1 else TOO_LARGE}"
        )
    return words


def _check_speed(tracker: AbstractTracker, recording: Recording) -> str:
    per_row = []
    for rows in LENGTHS:
        batch = stack([_repeated(recording, rows)])._replace(truth={})
        program = eqx.filter_make_jaxpr(filter_batch)(as_dtype(tracker, batch.dt.dtype), batch)[0]
        per_row.append(computed_numbers(program.jaxpr) / rows)
    few, many = per_row
    if many > GROWTH * few:
        raise BrokenContract(
            f"each of {LENGTHS[1]} rows computes {many:.0f} numbers, each of {LENGTHS[0]} rows {few:.0f}, expected as "
            "many: the time is not linear in the rows; usual fix: jax.lax.scan with a carry of fixed size, no array "
            "with an axis of rows inside"
        )
    longer, seconds = _repeated(recording, LENGTHS[1]), []
    for _ in range(4):
        started = time.process_time()
        tracker.run(longer)
        seconds.append(time.process_time() - started)
    fastest = min(seconds[1:])
    return (
        f"{many:.0f} numbers and {1e6 * fastest / LENGTHS[1]:.2g} µs a row of {LENGTHS[1]}, "
        f"{max(seconds[0] - fastest, 0.0):.2g} s to compile"
    )


def _repeated(recording: Recording, rows: int) -> Recording:
    """The recording again and again, one after another in time, up to this number of rows."""
    index = np.arange(rows) % len(recording)
    span = recording.times[-1] - recording.times[0] + np.median(np.diff(recording.times))
    times = recording.times[index] + span * (np.arange(rows) // len(recording))
    readings, inputs, truth = each_array(recording, lambda x: x[index])
    return replace(recording, times=times, readings=readings, inputs=inputs, truth=truth)


def computed_numbers(program: Any) -> int:
    """The numbers that all operations of a jaxpr yield; a loop counts once per turn, once where turns are unknown."""
    total = 0
    for operation in program.eqns:
        inner = [computed_numbers(part) for part in _programs(operation.params)]
        if not inner:
            total += sum(math.prod(getattr(out.aval, "shape", ())) for out in operation.outvars)
        elif operation.primitive.name == "cond":
            total += max(inner)
        else:
            total += sum(inner) * int(operation.params.get("length", 1))
    return total


def _programs(params: dict[str, Any]) -> Iterator[Any]:
    """The jaxprs among the parameters of an operation."""
    for value in params.values():
        for one in value if isinstance(value, (tuple, list)) else (value,):
            part = getattr(one, "jaxpr", one)
            if hasattr(part, "eqns"):
                yield part
