"""tuned.toml: what a fit found comes back into the same tracker, whatever its stations are called."""

import tomllib
from types import SimpleNamespace

import numpy as np
import pytest

from trackwright.sim.stations import work_station
from trackwright.trackers.aoa.direct import direct_tracker
from trackwright.trackers.aoa.fusion import bearing_tracker
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.tunable import tunables, with_values
from trackwright.trackers.recordings.files import identity
from trackwright.tuning.parameters import flatten, physical, select_parameters, with_parameters
from trackwright.tuning.tuned_file import read_tuned, tuned_content, write_tuned


def _result(tracker, patterns):
    """What a fit would return that had moved every number a little."""
    parameters = select_parameters(tracker, patterns)
    vector = flatten(parameters)
    vector = vector + np.linspace(0.1, 0.2, len(vector))
    labels, values = [p.label for p in parameters], map(np.asarray, physical(parameters, vector))
    named = dict(zip(labels, values, strict=True))
    errors = {k: np.full(v.shape, np.nan) if k.endswith("a") else 0.1 * np.abs(v) for k, v in named.items()}
    return SimpleNamespace(
        tracker=with_parameters(tracker, parameters, vector),
        parameters=parameters,
        values=named,
        standard_errors=errors,
        value=1.25,
        start_value=2.5,
    )


def _numbers(tracker):
    return {name: np.asarray(node.value) for name, node in tunables(tracker).items()}


def _direct(*names):
    return direct_tracker(dict(zip(names, work_station().stations.values(), strict=False)))


@pytest.mark.parametrize(
    ("tracker", "patterns"),
    [
        (bearing_tracker(4), "*"),
        (bearing_tracker(4), ["motion.*", "tied:sensors.bearings.sigma_*"]),
        (_direct("1", "2", "3"), ["motion.sigma_a", "tied:sensors.*.sigma_p", "sensors.*.offsets"]),
        (_direct("10.0.0.1", 'the "old" one', "[ab]"), ["sensors.*", "start.*"]),
        (_direct("Süd\\West", "a b", "#"), ["tied:sensors.*.sigma_p"]),
    ],
)
def test_what_was_tuned_comes_back_and_nothing_else_changes(tmp_path, tracker, patterns):
    result = _result(tracker, patterns)
    write_tuned(tmp_path / "tuned.toml", tuned_content("any", "nll", result, {}))
    back = with_values(tracker, read_tuned(tmp_path / "tuned.toml").values, tmp_path / "tuned.toml")
    expected, found = _numbers(result.tracker), _numbers(back)
    assert set(expected) == set(found)
    for name, value in expected.items():
        # a Scale is stored as its logarithm: one rounding
        np.testing.assert_allclose(found[name], value, rtol=1e-14)


def test_the_file_says_value_unit_and_standard_error_of_each(tmp_path):
    result = _result(bearing_tracker(4), ["motion.sigma_a", "sensors.*.offsets"])
    ends = {"motion.sigma_a": (np.array(0.1), np.array(0.4))}
    write_tuned(tmp_path / "tuned.toml", tuned_content("bearings", "nll", result, ends))
    content = tomllib.loads((tmp_path / "tuned.toml").read_text())
    assert (content["tracker"], content["objective"]) == ("bearings", "nll")
    assert (content["before"], content["after"]) == (2.5, 1.25)
    sigma_a, offsets = (content["tunables"][k] for k in ("motion.sigma_a", "sensors.bearings.offsets"))
    assert sigma_a["unit"] == "m/s^2/sqrt(Hz)"
    assert sigma_a["value"] == float(result.values["motion.sigma_a"])
    assert np.isnan(sigma_a["standard_error"])
    assert (sigma_a["lowest_95"], sigma_a["highest_95"]) == (0.1, 0.4)
    assert np.isnan(offsets["lowest_95"]).all()
    assert offsets["value"] == result.values["sensors.bearings.offsets"].tolist()
    assert offsets["standard_error"] == pytest.approx(0.1 * np.abs(offsets["value"]))


def test_the_file_names_the_calibration_of_its_recordings(tmp_path):
    (tmp_path / "cal.toml").write_text("a calibration")
    own = identity(tmp_path / "cal.toml")
    content = tuned_content("bearings", "nll", _result(bearing_tracker(4), "motion.*"), {}, own)
    assert read_tuned(write_tuned(tmp_path / "tuned.toml", content)).calibration == own
    assert own["name"] == "cal.toml"
    (tmp_path / "cal.toml").write_text("another calibration")
    assert identity(tmp_path / "cal.toml")["fingerprint"] != own["fingerprint"]
    write_tuned(tmp_path / "tuned.toml", content | {"calibration": "cal.toml"})
    with pytest.raises(UnusableInput, match="calibration = 'cal.toml', expected a table"):
        read_tuned(tmp_path / "tuned.toml")
