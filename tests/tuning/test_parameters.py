"""The tuned numbers of a tracker: which ones, under what name, as one vector and back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.tuning.worlds import STATION
from trackwright.trackers.aoa.direct import direct_tracker
from trackwright.trackers.aoa.fusion import bearing_tracker
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.core.model.tunable import Covariance, Fraction, Real, Scale, tunables
from trackwright.tuning.parameters import flatten, physical, physical_errors, select_parameters, with_parameters


@pytest.fixture(scope="module")
def direct():
    shifted = Station(STATION.position + 1.0, STATION.rotation, STATION.antennas, STATION.wavelength)
    return direct_tracker({"north": STATION, "south": shifted})


def test_tied_tunables_are_one_parameter_named_by_their_pattern(direct):
    (tied,) = select_parameters(direct, "tied:sensors.*.sigma_p")
    assert tied.label == "sensors.*.sigma_p"
    assert tied.names == ("sensors.north.sigma_p", "sensors.south.sigma_p")
    values = {k: v.value for k, v in tunables(with_parameters(direct, [tied], np.log([0.7]))).items()}
    assert values["sensors.north.sigma_p"] == values["sensors.south.sigma_p"] == pytest.approx(0.7)
    assert values["motion.sigma_a"] == tunables(direct)["motion.sigma_a"].value


def test_the_vector_goes_into_the_tracker_and_comes_back():
    tracker = bearing_tracker(4)
    parameters = select_parameters(tracker, ["motion.*", "sensors.*"])
    vector = flatten(parameters) + np.linspace(-0.5, 0.5, len(flatten(parameters)))
    placed = with_parameters(tracker, parameters, jnp.asarray(vector))
    np.testing.assert_array_equal(flatten(select_parameters(placed, ["motion.*", "sensors.*"])), vector)
    own = tunables(placed)
    for parameter, value in zip(parameters, physical(parameters, vector), strict=True):
        np.testing.assert_array_equal(value, own[parameter.label].value)
    untouched = {k for k in own if k.startswith("start.")}
    assert untouched
    assert all(np.array_equal(own[k].raw, tunables(tracker)[k].raw) for k in untouched)


def _parts():
    return {
        "a": Scale(0.3),
        "b": Real([0.2, -0.4], typical=0.1),
        "c": Fraction(0.2),
        "d": Covariance([[4.0, 1.0], [1.0, 2.0]]),
    }


def test_standard_errors_of_physical_values_match_those_of_drawn_vectors():
    parameters = select_parameters(_parts(), "*")
    vector = flatten(parameters)
    assert vector.shape == (8,)
    rng = np.random.default_rng(2)
    root = 1e-3 * rng.normal(size=(8, 8))
    draws = vector + rng.normal(size=(20_000, 8)) @ root.T
    drawn = jax.vmap(lambda v: physical(parameters, v))(jnp.asarray(draws))
    errors = physical_errors(parameters, vector, root @ root.T, np.zeros(8, bool))
    for error, values in zip(errors, drawn, strict=True):
        # 20,000 draws know a standard deviation to half a percent; the curvature at 1e-3 adds less
        np.testing.assert_allclose(error, np.std(values, axis=0), rtol=0.03)
    assert [e.shape for e in errors] == [(), (2,), (), (2, 2)]
    *_, of_matrix = physical_errors(parameters, vector, root @ root.T, np.arange(8) == 6)  # its factor's lower entry
    assert np.isnan(of_matrix).tolist() == [[False, True], [True, True]]
