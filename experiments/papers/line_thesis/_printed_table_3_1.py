"""Table 3.1 as printed, cm: measurement, Kalman filter and particle filter of nine recordings, and the averages."""

from __future__ import annotations

PRINTED = {
    "situation 1, set 1": (31.1, 24.4, 16.3),
    "situation 1, set 2": (31.2, 25.8, 16.9),
    "situation 1, set 3": (52.8, 31.7, 16.1),
    "situation 2, set 1": (30.3, 25.2, 15.8),
    "situation 2, set 2": (33.5, 24.3, 14.9),
    "situation 2, set 3": (29.4, 24.5, 13.7),
    "situation 3, set 1": (38.7, 31.2, 20.2),
    "situation 3, set 2": (44.8, 31.1, 19.6),
    "situation 3, set 3": (60.8, 33.7, 24.8),
}
AVERAGES = (39.2, 27.9, 17.6)
COLUMNS = ("raw", "Kalman", "particle")
