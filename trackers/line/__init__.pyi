from trackwright.trackers.core.model.polyline import Polyline as Polyline
from trackwright.trackers.line.grid import GridFilter as GridFilter
from trackwright.trackers.line.motion import HaltingMotion as HaltingMotion
from trackwright.trackers.line.motion import LineMotion as LineMotion
from trackwright.trackers.line.rows import fit_path_truth as fit_path_truth
from trackwright.trackers.line.tracker import line_grid_tracker as line_grid_tracker
from trackwright.trackers.line.tracker import line_motion as line_motion
from trackwright.trackers.line.tracker import line_tracker as line_tracker
from trackwright.trackers.line.truth import knot_times as knot_times

__all__ = [
    "GridFilter",
    "HaltingMotion",
    "LineMotion",
    "Polyline",
    "fit_path_truth",
    "knot_times",
    "line_grid_tracker",
    "line_motion",
    "line_tracker",
]
