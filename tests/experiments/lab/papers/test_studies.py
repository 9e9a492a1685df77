"""Every study of a paper and of a question runs, with finite numbers and evidence, and draws."""

from dataclasses import replace

import numpy as np
import pytest

from trackwright.experiments.monte_carlo.runner import run_study
from trackwright.experiments.monte_carlo.sources import available_studies, load_study
from trackwright.experiments.text.expectations import Conclusion, ExpectedResult


@pytest.mark.slow
@pytest.mark.parametrize("name", available_studies())
def test_a_study_runs_and_draws(name, tmp_path):
    study = load_study(name)
    results = run_study(replace(study, runs=4, metrics=study.metrics[:2]), tmp_path)
    found = list(study.expected(results))
    assert found
    assert all(np.isfinite(c.ours.value) for c in found if isinstance(c, ExpectedResult))
    assert all(c.evidence for c in found if isinstance(c, Conclusion))
    pictures = study.draw(results, tmp_path) if study.draw else []
    assert all((tmp_path / picture).read_text("utf-8").startswith("<svg") for picture in pictures)
    assert all((tmp_path / picture).stat().st_size > 2000 for picture in pictures)
