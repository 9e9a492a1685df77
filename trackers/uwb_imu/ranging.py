"""Two-way ranging: distances from the time stamps of messages that two clocks took, on the host in double precision.

Each node's clock is its own. The drift is the rate of the answering node's clock against the asking one's, less one;
crystals keep it within 2e-5. With δ the drift and t_r the answer's delay, single-sided ranging is wrong by c·δ·t_r/2:
1.5 m at 1e-5 and 1 ms. Double-sided ranging is wrong by δ times the distance.
"""

from __future__ import annotations

from typing import Any

import numpy as np

SPEED_OF_LIGHT = 299_792_458.0
"""m/s; the paper rounds to 3e8, which makes ten metres 7 mm longer."""


def elapsed(start: Any, stop: Any, period: float | None = None) -> np.ndarray:
    """Seconds from one time stamp to a later one of the same clock, whose counter starts anew every `period` s."""
    interval = np.asarray(stop, float) - np.asarray(start, float)
    return interval if period is None else np.mod(interval, period)


def single_sided(total: Any, reply: Any, drift: Any = 0.0) -> np.ndarray:
    """Distance, m, from the time t₂ − t₁ between asking and the answer's arrival and the answer's delay t_r, both s.

    Equations (8) and (9) of Kwon et al. 2021. `total` by the asking node's clock, `reply` by the answering one's,
    which is brought to the asking clock by its `drift`.
    """
    flight = (np.asarray(total, float) - np.asarray(reply, float) / (1.0 + np.asarray(drift, float))) / 2.0
    return np.asarray(SPEED_OF_LIGHT * flight)


def double_sided(total: Any, reply: Any, second_total: Any, second_reply: Any) -> np.ndarray:
    """Distance, m, from two turns: the asking node's total and the answer's delay, then the other way round, all s.

    `total` and `second_reply` by the asking node's clock, `reply` and `second_total` by the answering one's. The
    products cancel the drift whatever the delays (Neirynck, Luk, McLaughlin 2016, equation 12).
    """
    first, second, wait, second_wait = (np.asarray(x, float) for x in (total, second_total, reply, second_reply))
    flight = (first * second - wait * second_wait) / (first + second + wait + second_wait)
    return np.asarray(SPEED_OF_LIGHT * flight)


def clock_drift(sent: Any, received: Any) -> float:
    """The drift of the answering clock from messages: `sent` by the asking clock, `received` by the answering, s.

    The slope of the receiving times over the sending times, less one, by least squares; a distance that grows at
    1 m/s counts as 3e-9. Raises ValueError for fewer than two messages or equal times.
    """
    sent, received = np.asarray(sent, float), np.asarray(received, float)
    along = sent - sent.mean() if sent.size else sent
    if sent.size < 2 or sent.shape != received.shape or not np.any(along):
        raise ValueError(f"a drift takes two messages at different times; found {sent.size} and {received.size}")
    late = (received - received[0]) - (sent - sent[0])
    return float(along @ late / (along @ along))
