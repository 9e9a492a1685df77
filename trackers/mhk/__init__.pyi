from trackwright.trackers.mhk.tracker import mhk_tracker as mhk_tracker

__all__ = ["mhk_tracker"]
