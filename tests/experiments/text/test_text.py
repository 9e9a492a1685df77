"""Numbers, units and tables as text, evaluations, and when a printed number counts as reached."""

import pytest

from trackwright.experiments.text.expectations import PREDICTED, ExpectedResult, Value
from trackwright.experiments.text.tables import Unit

MM = Unit("mm", 1.0)


@pytest.mark.parametrize(
    ("printed", "ours", "ratio", "reached"),
    [
        # 6.3 % of the errors exceed 10 cm, where 1.7 % are printed to.
        (98.3, 93.7, 6.3 / 1.7, False),
        (98.3, 98.2, 1.8 / 1.7, True),
        # A small share is compared as it is: its rest would hide everything.
        (5.0, 8.0, 1.6, False),
        (5.0, 5.4, 1.08, True),
    ],
)
def test_a_share_is_compared_by_the_smaller_of_it_and_its_rest(printed, ours, ratio, reached):
    result = ExpectedResult("Table 1", printed, Value(ours, ours, ours), "%", PREDICTED, share=True)
    assert result.ratio == pytest.approx(ratio)
    assert result.reached is reached
