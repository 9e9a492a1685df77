"""trackwright: how accurate is this tracker, and with which noise levels?

A recording holds what the sensors of an installation measured, and the truth if there is any. A tracker turns a
recording into estimates. Tuning returns the same tracker with better noise levels. A world simulates recordings.

    import trackwright as tw

    recording = tw.read("my-folder")
    tracker = tw.tracker_for(recording)
    estimates = tracker.run(recording)
    print(tw.evaluate(estimates, recording))

All public names of `trackwright.trackers`, `.sim` and `.tuning` are here, each imported when it is first used, and
`trackwright.plot` draws them; docs/concepts.md shows how they fit.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from trackwright import sim, trackers, tuning
from trackwright.trackers.core.errors import near

if TYPE_CHECKING:
    from trackwright.experiments.pages.plots import notebook as plot
    from trackwright.sim import *  # noqa: F403
    from trackwright.sim import worlds as simulate
    from trackwright.trackers import *  # noqa: F403
    from trackwright.tuning import *  # noqa: F403

try:
    __version__ = version("trackwright")
except PackageNotFoundError:
    __version__ = "unknown: not installed"

MODULES = {"simulate": "trackwright.sim.worlds", "plot": "trackwright.experiments.pages.plots.notebook"}
"""Names that stand for modules: worlds, and plots that return matplotlib axes."""

__all__ = ["plot", "simulate", *trackers.__all__, *sim.__all__, *tuning.__all__]


def __getattr__(name: str) -> Any:
    if name in MODULES:
        found = import_module(MODULES[name])
    else:
        package = next((package for package in (trackers, sim, tuning) if name in package.__all__), None)
        if package is None:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}{near(name, __all__)}")
        found = getattr(package, name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
