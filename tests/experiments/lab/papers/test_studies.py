"""Every study of a paper runs, with finite numbers and evidence."""

from dataclasses import replace

import numpy as np
import pytest

from trackwright.experiments.monte_carlo.runner import run_study
from trackwright.experiments.monte_carlo.sources import available_studies, load_study
from trackwright.experiments.text.expectations import Conclusion, ExpectedResult


@pytest.mark.slow
@pytest.mark.parametrize("name", available_studies())
def test_a_study_runs(name, tmp_path):
    study = load_study(name)
    results = run_study(replace(study, runs=4, metrics=study.metrics[:2]), tmp_path)
    found = list(study.expected(results))
    assert found
    assert all(np.isfinite(c.ours.value) for c in found if isinstance(c, ExpectedResult))
    assert all(c.evidence for c in found if isinstance(c, Conclusion))
