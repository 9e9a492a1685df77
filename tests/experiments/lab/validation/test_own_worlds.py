"""In worlds of a tracker's own model: NIS as expected, and fits that recover the parameters."""

import pytest

from trackwright.experiments.lab.cases import Output
from trackwright.experiments.lab.validation import nis_expectation
from trackwright.experiments.lab.validation.recovery import recovery
from trackwright.trackers.core.errors import UnusableInput


@pytest.mark.slow
def test_nis_per_degree_of_freedom_is_one(monkeypatch):
    monkeypatch.setattr(nis_expectation, "TAGS", 8)
    tracker, found = nis_expectation.estimates("uwb", 0)
    ratio, inside = nis_expectation.means(found, tracker)
    assert ratio == pytest.approx(1.0, abs=0.1)
    assert inside > 0.85


@pytest.mark.slow
def test_two_hundred_fits_to_ranges_recover_the_truth_with_the_right_coverage(tmp_path):
    assert recovery("C", output=Output(out=tmp_path / "recovery.json")) == 0


def test_a_system_that_does_not_exist_is_refused():
    with pytest.raises(UnusableInput, match="'E': unknown; expected some of A, B, C, D"):
        recovery("E")
