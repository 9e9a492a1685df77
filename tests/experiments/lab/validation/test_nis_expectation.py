"""NIS in a world of the tracker's own model is as expected, with skewed Student's t noise, too."""

import pytest

from trackwright.experiments.lab.validation import nis_expectation
from trackwright.experiments.lab.validation.nis_expectation import estimates, means


@pytest.mark.slow
def test_nis_per_degree_of_freedom_is_one_in_a_world_of_the_own_model(monkeypatch):
    monkeypatch.setattr(nis_expectation, "TAGS", 8)
    tracker, found = estimates("uwb", 0)
    ratio, inside = means(found, tracker)
    assert ratio == pytest.approx(1.0, abs=0.1)
    assert inside > 0.85
