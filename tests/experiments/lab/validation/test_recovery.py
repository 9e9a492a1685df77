"""Fits to data of a tracker's own model recover its parameters, with intervals of the right coverage."""

import pytest

from trackwright.experiments.lab.cases import Output
from trackwright.experiments.lab.validation.recovery import recovery
from trackwright.trackers.core.errors import UnusableInput


@pytest.mark.slow
def test_two_hundred_fits_to_ranges_recover_the_truth_with_the_right_coverage(tmp_path):
    assert recovery("C", output=Output(out=tmp_path / "recovery.json")) == 0


def test_a_system_that_does_not_exist_is_refused():
    with pytest.raises(UnusableInput, match="'E': unknown; expected some of A, B, C, D"):
        recovery("E")
