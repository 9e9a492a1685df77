"""Sites of real recordings, their trackers and limits, and where the recordings are."""

import os
from collections.abc import Mapping
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import NamedTuple

import trackwright as tw
from trackwright.experiments.lab.subprocesses import required_recordings
from trackwright.trackers.recordings.calibration import has_moved, has_turned


class Site(NamedTuple):
    """The recordings whose names match, their trackers, and the limits of horizontal RMSE, m, of the first of these.

    `still`: the tags do not move, so that their errors are one sample: by default levels alone. `others`: names of
    recordings beside these on which they are calibrated.
    """

    pattern: str
    trackers: tuple[str, ...]
    limits: Mapping[str, float] = {}
    still: bool = False
    others: str = ""


# fmt: off
SITES = (
    Site("ble51-walk-*", ("bearings",), {"defaults": 0.75, "calibrated": 0.42, "calibrated smoothed": 0.30}),
    Site("ble51-uca-*", ("beam", "das"), still=True),
    Site("starloc-fast-*", ("uwb", "uwb-imu"), {"defaults": 0.15, "calibrated": 0.13}),
    Site("starloc-2d-*", ("uwb",)),
    Site("lias-planar-*", ("uwb",), {"defaults": 0.075, "calibrated": 0.05}, others="lias-still-*"),
    Site("rcv-drone-*", ("uwb",), {"defaults": 0.20, "calibrated": 0.17}),
    Site("iasl-drone-*", ("uwb", "uwb-imu", "fusion", "fix-kf"), {"defaults": 0.055, "calibrated": 0.045}),
    Site("isas-walk-*", ("uwb", "uwb-imu"), {"defaults": 0.14, "calibrated": 0.11}),
    Site("labyrinth*", ("uwb", "body", "trilateration-compensated")),
    # A straight path: in the line of sight, behind a wall, and obstructed.
    Site("ngbui-line-1-*", ("uwb", "line-grid"), {"defaults": 0.055, "calibrated": 0.045}),
    Site("ngbui-line-2-*", ("uwb", "line-grid"), {"defaults": 0.42, "calibrated": 0.30}),
    Site("ngbui-line-3-*", ("uwb", "line-grid"), {"defaults": 0.40, "calibrated": 0.25}),
    # Late fixes of drones, which may be mirrored in the anchors' plane.
    Site("tiers-*", ("fix-mirror", "fix-kf")),
    # Range differences of a quadrotor, in a clear and in a cluttered room.
    Site("util-c1-*", ("tdoa",), {"defaults": 0.047}),
    Site("util-c4-*", ("tdoa",), {"defaults": 0.152}),
)
# fmt: on
"""Every site; a recording without a site is not judged."""


def same_installation(a: tw.RecordingFolder, b: tw.RecordingFolder) -> bool:
    """Whether two recordings have stations or anchors in common, and those stand where they stood."""
    stations = [name for name in a.rig.stations if name in b.rig.stations]
    anchors = [name for name in a.rig.anchors if name in b.rig.anchors]
    moved = any(has_turned(a.rig.stations[name], b.rig.stations[name]) for name in stations)
    moved |= any(has_moved(a.rig.anchors[name], b.rig.anchors[name]) for name in anchors)
    return bool(stations or anchors) and not moved


def site_of(name: str) -> Site:
    """The site of a recording."""
    return next(site for site in SITES if fnmatch(name, site.pattern))


@cache
def paths() -> Mapping[str, Path]:
    """The folders of recordings and of flights, in `recordings-tdoa` beside them or TRACKWRIGHT_FLIGHTS, by name."""
    folder = required_recordings()
    flights = Path(os.environ.get("TRACKWRIGHT_FLIGHTS", folder.with_name("recordings-tdoa")))
    files = [file for root in (folder, flights) for file in root.glob("*/rig.toml")]
    return {file.parent.name: file.parent for file in sorted(files, key=lambda file: file.parent.name)}


def recordings(pattern: str) -> list[str]:
    """The names of recordings that match."""
    return [name for name in paths() if fnmatch(name, pattern)]


@cache
def read(name: str) -> tw.RecordingFolder:
    """The recording of a name."""
    return tw.read(paths()[name])
