"""Two-way ranging: distances from the time stamps of two clocks, on the host in double precision.

The clock drift δ is the rate of the responder's clock relative to the initiator's, less one; crystals keep it within
2e-5. With the reply delay t_r the error of single-sided ranging is c·δ·t_r/2, 1.5 m at 1e-5 and 1 ms. That of
double-sided ranging is the distance times the mean error of both clocks' rates, 0.6 mm at 30 m and 2e-5.
"""

from __future__ import annotations

from typing import Any

import numpy as np

SPEED_OF_LIGHT = 299_792_458.0
"""m/s; the paper rounds to 3e8, an error of 7 mm in ten metres."""


def single_sided(total: Any, reply: Any, drift: Any = 0.0) -> np.ndarray:
    """Distance, m, by single-sided two-way ranging (Kwon et al. 2021, equations 8 and 9).

    `total`: round-trip time t₂ − t₁ by the initiator's clock, s. `reply`: reply delay t_r by the responder's clock, s,
    corrected for its `drift`.
    """
    flight = (np.asarray(total, float) - np.asarray(reply, float) / (1.0 + np.asarray(drift, float))) / 2.0
    return np.asarray(SPEED_OF_LIGHT * flight)


def double_sided(total: Any, reply: Any, second_total: Any, second_reply: Any) -> np.ndarray:
    """Distance, m, by double-sided two-way ranging: two round-trip times and two reply delays, all s.

    `total` and `second_reply` by the initiator's clock, `reply` and `second_total` by the responder's. The error
    does not depend on the delays (Neirynck, Luk, McLaughlin 2016, equation 12).
    """
    first, second, delay, second_delay = (np.asarray(x, float) for x in (total, second_total, reply, second_reply))
    flight = (first * second - delay * second_delay) / (first + second + delay + second_delay)
    return np.asarray(SPEED_OF_LIGHT * flight)
