"""The search for the levels of other estimators."""

import numpy as np
import pytest

from trackwright.experiments.lab.validation.peer_levels import levels_at, searched


@pytest.mark.parametrize(("span", "found"), [(4, (-3, 2)), (2, (-2, 2)), (0, (0, 0))])
def test_the_search_ends_at_the_optimum_or_at_the_end_of_its_span(span, found):
    best_of_all = np.log(levels_at(-3, 2))

    def mean(levels):
        return np.linalg.norm(np.log(levels) - best_of_all)

    best, tried = searched(mean, span)
    assert best == found
    assert len(tried) < (2 * span + 1) ** 2 or span < 3
