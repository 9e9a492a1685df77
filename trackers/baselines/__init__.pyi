from trackwright.trackers.baselines.fixes import MovingWindow as MovingWindow
from trackwright.trackers.baselines.fixes import fix_tracker as fix_tracker
from trackwright.trackers.baselines.fixes import singer_tracker as singer_tracker
from trackwright.trackers.baselines.switching import mirror_tracker as mirror_tracker
from trackwright.trackers.baselines.switching import switching_tracker as switching_tracker
from trackwright.trackers.from_arrays import fix_recording as fix_recording

__all__ = ["MovingWindow", "fix_recording", "fix_tracker", "mirror_tracker", "singer_tracker", "switching_tracker"]
