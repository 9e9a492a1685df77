"""Cautions on a fit: each on data made so that it applies, and none on data of the model itself."""

from dataclasses import replace
from itertools import product
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

import trackwright as tw
from tests.known_start import recording
from tests.tuning.worlds import SIGMA_START, line_tracker, walks
from trackwright.trackers.core.data.recording import Recording
from trackwright.tuning.correlation import WINDOWS_S, window_sums
from trackwright.tuning.fit_cautions import correlation, standstill
from trackwright.tuning.optimisers import AbstractOptimiser

LEVELS = ("motion.sigma_v", "sensors.gauge.sigma")


def _gauge(places, errors, step=0.1):
    """A gauge's recording of these places and errors at a constant rate."""
    values = np.asarray(places + errors)[:, None]
    made = recording(
        step * np.arange(len(values)), {"gauge": (values, np.ones_like(values, bool))}, [0.0], [[SIGMA_START**2]]
    )
    return Recording(made.times, made.readings, made.inputs)


def _walk(rng, rows, sigma_v=0.3, step=0.1):
    return 0.3 * rng.normal() + np.cumsum(sigma_v * np.sqrt(step) * rng.normal(size=rows))


def _gauss_markov(rng, rows, sigma, length, step=0.1):
    """Errors whose correlation falls by e every `length` s."""
    a, x = np.exp(-step / length), np.empty(rows)
    x[0] = sigma * rng.normal()
    for k in range(1, rows):
        x[k] = a * x[k - 1] + sigma * np.sqrt(1 - a * a) * rng.normal()
    return x


def test_a_fit_to_data_of_the_model_has_no_cautions():
    result = tw.fit(line_tracker(0.5, 0.1), walks([500, 400, 450, 500], 1), "nll", LEVELS)
    assert result.cautions == []
    assert "caution" not in repr(result)


def test_readings_that_repeat_stop_at_their_rounding_and_are_named():
    rng = np.random.default_rng(2)
    # a slow walk on a grid of 0.2 m: most readings repeat, and a likelihood would take the noise to zero
    places = np.round(_walk(rng, 600, 0.05) / 0.2) * 0.2
    result = tw.fit(line_tracker(0.05, 0.1), _gauge(places, 0 * places), "nll", LEVELS)
    sigma = float(result.values["sensors.gauge.sigma"])
    assert sigma == pytest.approx(0.2 / np.sqrt(12), rel=1e-3)
    rounding, repeats = result.cautions[:2]
    assert rounding.startswith("sensors.gauge.sigma fell to 0.0577 m, the rounding of its readings (step 0.2 m / √12)")
    assert "% of the readings of gauge repeat the one before (in steps of 0.2 m)" in repeats
    free = tw.fit(line_tracker(0.05, 0.1), _gauge(places, 0 * places), "nll", LEVELS, bounds={"sensors.*": (1e-3, 1.0)})
    assert float(free.values["sensors.gauge.sigma"]) < 0.05, "the user's own bounds count"


def test_a_noise_level_that_collapses_without_a_grid_is_named():
    places = _walk(np.random.default_rng(3), 600)
    result = tw.fit(line_tracker(0.3, 30.0), _gauge(places, 0 * places), "nll", LEVELS)
    assert any(text.startswith("sensors.gauge.sigma collapsed to ") for text in result.cautions)
    far = tw.fit(line_tracker(0.3, 1e4), walks([400], 1), "nll", LEVELS)
    assert not any("collapsed" in text for text in far.cautions), "a level that the recordings determine"


def test_one_recording_that_decides_is_named():
    rng = np.random.default_rng(4)
    made = [_gauge(_walk(rng, 300), s * rng.normal(size=300)) for s in (0.1, 0.1, 2.0, 0.1)]
    result = tw.fit(line_tracker(), made, "nll", LEVELS)
    (text,) = (text for text in result.cautions if "decides" in text)
    assert text.startswith("recording 3 decides the fit: without it sensors.gauge.sigma would be ")
    alone = tw.fit(line_tracker(), [*made[:2], made[3]], "nll", LEVELS)
    factor = float(result.values["sensors.gauge.sigma"] / alone.values["sensors.gauge.sigma"])
    assert float(text.split(" would be ")[1].split(" times")[0]) == pytest.approx(factor, rel=0.05)
    assert text.endswith("times smaller")


def test_correlated_errors_are_named_with_how_much_too_narrow_intervals_are():
    rng, rows = np.random.default_rng(5), 6000
    errors = _gauss_markov(rng, rows, 0.3, 2.0) * np.exp(_gauss_markov(rng, rows, 0.8, 5.0))
    result = tw.fit(line_tracker(0.2, 0.3), _gauge(_walk(rng, rows), errors), "nll", LEVELS)
    (text,) = result.cautions
    assert text.startswith("innovations are correlated over time: 5999 rows carry the information of about ")
    factor = float(text.split(" about ")[2].split(" times")[0])
    assert 2.0 < factor < np.sqrt(max(WINDOWS_S) / 0.1)


def test_rows_that_carry_the_information_of_half_as_many_are_named():
    # Every row comes twice; the deviations of pairs, as all 16 patterns of signs in turn, have no other correlation.
    signs = np.repeat(list(product([-1.0, 1.0], repeat=4)) * 2, 2)
    sums = window_sums(np.arange(len(signs)) / 8, 1.0 + 0.5 * signs, np.zeros(len(signs)))
    problem = SimpleNamespace(few=False, parts=SimpleNamespace(run=lambda *_: [(sums,)]))
    (text,) = correlation(problem, np.zeros(2))
    assert "256 rows carry the information of about 128 independent ones" in text
    assert "about 1.4 times too narrow" in text


class Stuck(AbstractOptimiser):
    """An optimiser that never moves."""

    monotone: ClassVar[bool] = True

    def init(self, vectors):
        return vectors

    def propose(self, state, vectors, gradients):
        return 0.0 * vectors, state


def test_a_fit_that_does_not_move_from_its_start_has_others():
    result = tw.fit(line_tracker(30.0, 0.01), walks([300, 300], 6), "nll", LEVELS, optimiser=Stuck())
    assert len(result.starts) > 1
    assert result.value < result.start_value - 1.0
    assert result.cautions == []


def test_a_fit_that_stays_where_it_was_says_so():
    (text,) = standstill(np.zeros(2), np.array([0.0, 1e-9]))
    assert text.startswith("the fit did not move from its starting values")
    assert text.endswith("has a better objective")
    assert standstill(np.zeros(2), np.array([0.0, 1e-3])) == []


def test_a_fit_that_held_out_recordings_keep_at_its_start_has_no_better_point_on_those():
    own, other = walks([300], 6), walks([300], 7)
    result = tw.fit(line_tracker(), own, "nll", LEVELS, starts=1, steps=2, held_out=other)
    assert result.selected
    stayed = replace(result, vector=result.start_vector, uncertainty=None)
    assert stayed.cautions[0].endswith("a better objective on the held-out recordings")
    assert not tw.fit(line_tracker(), own, "nll", LEVELS, starts=1, steps=2).selected
