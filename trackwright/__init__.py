"""trackwright: how accurate is this tracker, and with which noise levels?

A recording holds what the sensors of an installation measured, and the truth if there is any. A tracker turns a
recording into estimates. Tuning returns the same tracker with better noise levels. A world simulates recordings.

    import trackwright as tw

    recording = tw.read("my-folder")
    tracker = tw.tracker_for(recording)
    estimates = tracker.run(recording)
    print(tw.evaluate(estimates, recording))
"""

from importlib.metadata import PackageNotFoundError, version

from trackwright.trackers.core.on_demand import names_on_demand

try:
    __version__ = version("trackwright")
except PackageNotFoundError:
    __version__ = "unknown: not installed"

__getattr__, __dir__, __all__ = names_on_demand(__name__, __file__)
