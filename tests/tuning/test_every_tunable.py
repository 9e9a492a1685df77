"""Every number of every tracker of the catalogue: found by its name, with the derivative that differences have."""

import fnmatch

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.catalogue import CASES, ROWS, trajectories
from tests.tuning.worlds import line_tracker, walks
from trackwright.trackers.aoa.fusion import AbstractBearingSensor
from trackwright.trackers.catalogue import TRACKERS
from trackwright.trackers.core.data.recording import Recording, stack
from trackwright.trackers.core.run.chunks import as_dtype
from trackwright.tuning.objectives import NegativeLogLikelihood, RootMeanSquareError
from trackwright.tuning.parameters import component_names, flatten, select_parameters, with_parameters
from trackwright.tuning.problem import Problem
from trackwright.tuning.uncertainty import unidentifiable

STEP = 1e-5


def test_a_number_without_effect_is_reported_as_that():
    tracker = line_tracker()
    parameters = select_parameters(tracker, ("motion.sigma_v", "sensors.gauge.sigma"))
    # rows at the same time do not depend on the speed at which the position changes
    still = [Recording(0 * r.times, r.readings, r.inputs, r.truth) for r in walks([30] * 4, 0)]
    problem = Problem(tracker, [stack(still)], NegativeLogLikelihood(), parameters)
    slopes = problem.evaluate(flatten(parameters)).term_gradients
    assert [n for n, idle in zip(component_names(parameters), unidentifiable(slopes), strict=True) if idle] == [
        "motion.sigma_v"
    ]


UNTUNED = ("das", "moving-average", "median")  # baselines without tunables

DIFFERENTIABLE = [
    pytest.param(case, id=name)
    for name, case in CASES.items()
    if case.causal and not case.draws and case.reads not in UNTUNED and f"{name} in space" not in CASES
]
"""Trackers with tunables and without random numbers; where there is one for space, it has all of the planar one's."""


@pytest.mark.slow
@pytest.mark.parametrize("case", DIFFERENTIABLE)
def test_the_derivative_by_every_tunable_is_the_central_difference(case, monkeypatch):
    """Of the likelihood and of the error, both at once; particles have a derivative of their own, see `tests/test_gradients.py`.

    Differences are taken with more than `FEW` trajectories: with few, an update of a diffuse prior loses digits to
    cancellation, and a difference divides the loss by the step. Derivatives are compared in both forms.
    """
    # Where bearings begin to bend the likelihood has a step, and how far they bend has no derivative.
    monkeypatch.setattr(AbstractBearingSensor, "curved", False)
    tracker, recordings = case.tracker(), case.recordings()
    batch = stack([*recordings, *recordings], rows=ROWS)
    entry, trajectory = TRACKERS[case.reads], trajectories(case.reads, case.free_height, case.source)[0]
    planar, bearing_only = entry.planar(trajectory, case.free_height), entry.bearing_only
    parameters = select_parameters(tracker, "*")
    vector = flatten(parameters)
    labels = np.array([p.label for p in parameters for _ in range(np.size(p.example.raw))])
    # A latency of zero is where a truth between rows has a corner, and a limit that is never reached has no effect.
    vector[np.char.endswith(labels, "latency")] += 0.264
    vector[labels == "median.speed_limit"] = np.log(0.3)
    error = RootMeanSquareError("direction" if bearing_only else "position", 2 if planar or bearing_only else 3)
    if "in the plane of the array" in case.name:
        error = NegativeLogLikelihood()  # an angle in the array's plane has no direction to compare
    model = as_dtype(tracker, batch.dt.dtype)

    def both(output, truth):
        return *NegativeLogLikelihood().terms(output, truth), *error.terms(output, truth)

    def figures(v, rows=batch):
        sums = [jnp.sum(x) for x in with_parameters(model, parameters, v).accumulate(rows, both)]
        heard = sums[1] > 0  # a baseline has no likelihood
        return jnp.stack([jnp.where(heard, sums[0] / jnp.where(heard, sums[1], 1.0), 0.0), error.value(sums[2:])])

    slopes = np.asarray(jax.jit(jax.jacfwd(figures))(jnp.asarray(vector)))
    # Ranges from curved waves are so poorly determined that the likelihood has but eight digits.
    step, rtol, digits = (1e-4, 1e-3, 5e-4) if case.reads == "direct" else (STEP, 1e-5, 1e-8)
    shifted = vector + step * np.concatenate([np.eye(len(vector)), -np.eye(len(vector))])
    up, down = np.split(np.asarray(jax.jit(lambda vs: jax.lax.map(figures, vs))(jnp.asarray(shifted))), 2)
    numeric = (up - down).T / (2 * step)
    assert np.all(np.isfinite(slopes))
    # step², and rounding of the figure / step
    atol = digits * np.maximum(1.0, np.abs(up).max(axis=0))[:, None]
    # A start is held fixed, also that of a fusion, whose readings depend on its beams.
    compared = ~np.char.startswith(labels, "beams.")
    assert np.all((np.abs(slopes - numeric) <= rtol * np.abs(numeric) + atol)[:, compared])
    of_few = jax.jit(lambda v: jax.jacfwd(figures)(v, stack(recordings, rows=ROWS)))(jnp.asarray(vector))
    np.testing.assert_allclose(of_few, slopes, rtol=1e-6, atol=digits * np.abs(slopes).max())
    idle = {label for label in set(labels) if not slopes[:, labels == label].any()}
    assert idle == {label for label in set(labels) if any(fnmatch.fnmatchcase(label, e) for e in case.idle)}
