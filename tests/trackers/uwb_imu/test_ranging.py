"""Two-way ranging by two clocks, against the times at which messages really leave and arrive."""

import numpy as np
import pytest

from trackwright.trackers.uwb_imu.trilateration import SPEED_OF_LIGHT, double_sided, single_sided

DISTANCE = np.array([0.5, 3.0, 25.0, 180.0])
FLIGHT = DISTANCE / SPEED_OF_LIGHT
REPLY, SECOND_REPLY = 0.8e-3, 1.7e-3


def _stamps(drift, own=0.0):
    """Time stamps by both clocks of two turns from 3 s on; the responder's clock is 5 s ahead and `drift` fast.

    `own`: the same of the initiator's clock.
    """
    asked = 3.0
    arrived = asked + FLIGHT
    answered = arrived + REPLY
    back = answered + FLIGHT
    again = back + SECOND_REPLY
    end = again + FLIGHT
    asking = [(1.0 + own) * x + 0.0 * FLIGHT for x in (asked, back, again)]
    answering = [5.0 + (1.0 + drift) * x for x in (arrived, answered, end)]
    return asking, answering


# 3 s, 8 s and 17 s in double precision resolve 4e-16 … 2e-15 s, which is a micrometre.
MICROMETRES = 5e-6


@pytest.mark.parametrize("drift", [0.0, 1e-5, -2e-5])
def test_single_sided_ranging_with_the_drift_known_is_the_distance(drift):
    (asked, back, _), (arrived, answered, _) = _stamps(drift)
    distance = single_sided(back - asked, answered - arrived, drift)
    np.testing.assert_allclose(distance, DISTANCE, atol=MICROMETRES)


def test_the_error_of_single_sided_ranging_is_half_the_drift_times_the_reply_delay():
    (asked, back, _), (arrived, answered, _) = _stamps(1e-5)
    error = single_sided(back - asked, answered - arrived) - DISTANCE
    np.testing.assert_allclose(error, -SPEED_OF_LIGHT * 1e-5 * REPLY / 2, atol=MICROMETRES)


@pytest.mark.parametrize(("own", "drift"), [(0.0, 0.0), (0.0, 2e-5), (0.0, -2e-5), (2e-5, 2e-5), (1e-5, -1e-5)])
def test_the_error_of_double_sided_ranging_is_the_mean_error_of_both_clocks_times_the_distance(own, drift):
    (asked, back, again), (arrived, answered, end) = _stamps(drift, own)
    turns = back - asked, answered - arrived, end - answered, again - back
    error = double_sided(*turns) - DISTANCE
    # Equal clocks, both fast: 3.6 mm at 180 m; opposite ones: nothing.
    np.testing.assert_allclose(error, 0.5 * (own + drift) * DISTANCE, atol=MICROMETRES)
