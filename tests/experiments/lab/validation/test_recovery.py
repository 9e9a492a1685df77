"""Fits to data of a tracker's own model recover its parameters, with intervals of the right coverage."""

import pytest

from trackwright.experiments.lab.validation.recovery import main


@pytest.mark.slow
def test_two_hundred_fits_to_ranges_recover_the_truth_with_the_right_coverage():
    assert main(("C",)) == 0


def test_a_system_that_does_not_exist_is_refused(capsys):
    assert main(("E",)) == 2
    assert "unknown system E: expected some of A, B, C, D" in capsys.readouterr().err
