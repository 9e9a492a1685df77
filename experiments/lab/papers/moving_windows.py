"""Moving mean or median of fixes over a window of any length, and the fixes themselves, as trackers of studies."""

from __future__ import annotations

from dataclasses import replace

from trackers.baselines.rows import TRACKERS
from trackers.baselines.windows import MovingWindow
from trackers.recordings.tracker_spec import TrackerSpec


def window(rows: int, median: bool = False) -> TrackerSpec:
    """The mean or median of the last `rows` fixes, per axis."""
    spec = TRACKERS["median" if median else "moving-average"]
    about = f"{'median' if median else 'mean'} of the last {rows} fixes"
    return replace(spec, about=about, build=lambda trajectory, planar: MovingWindow(rows, median, planar))


RAW = replace(window(1), about="the fixes as they are")
