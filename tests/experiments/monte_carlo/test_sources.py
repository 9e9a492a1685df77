"""The studies that come with the package."""

import pytest

from trackwright.experiments.monte_carlo.sources import available_studies, load_study


@pytest.mark.parametrize("name", available_studies())
def test_every_name_on_the_list_is_a_study_with_expected_results(name):
    study = load_study(name)
    assert study.name == name
    assert study.expected is not None
