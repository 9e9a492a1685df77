"""The trackers of the catalogue keep the contract that a user's own are checked against."""

import pytest

from tests.catalogue import CASES
from trackwright.trackers.conformance.trackers import tracker_checks

BITS = ("run", "padding", "later rows", "number and order", "hidden values", "cut and resume", "one program")
NUMBERS = ("single and batch", "accumulate", "gradient")
"""Further programs for each case: in the default suite `tests/trackers/conformance` has them for its own trackers."""

QUICK = [(case, name) for case in ("fix-kf", "median", "das") for name in BITS]
"""Of one of each kind: a Kalman filter, a window, a tracker without memory."""


def _params():
    return [
        pytest.param(case, name, id=f"{case.name}-{name}", marks=() if (case.name, name) in QUICK else pytest.mark.slow)
        for case in CASES.values()
        for name in (*BITS, *NUMBERS)
    ]


@pytest.fixture(scope="module")
def checks():
    """The checks of the last case by name; those of a case share its runs."""
    last = {}

    def of(case):
        if case.name not in last:
            last.clear()
            found = tracker_checks(case.tracker(), case.recordings(), causal=case.causal)
            last[case.name] = {str(check): check for check in found}
        return last[case.name]

    return of


@pytest.mark.parametrize(("case", "name"), _params())
def test_every_tracker_keeps_its_contract(checks, case, name):
    checks(case)[name]()


def test_every_check_is_one_of_these(checks):
    assert tuple(checks(CASES["median"])) == (*BITS, *NUMBERS)
