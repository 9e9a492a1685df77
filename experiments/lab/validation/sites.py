"""Sites of real recordings, their trackers, and where the recordings are."""

import os
from collections.abc import Mapping
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import NamedTuple

import trackwright as tw
from trackwright.experiments.lab.runner import required_recordings
from trackwright.trackers.recordings.calibration import has_moved, has_turned


class Site(NamedTuple):
    """The recordings whose names match, and their trackers.

    `still`: the tags do not move, so that their errors are one sample: by default levels alone. `others`: names of
    recordings beside these on which they are calibrated.
    """

    pattern: str
    trackers: tuple[str, ...]
    still: bool = False
    others: str = ""


SITES = (
    Site("ble51-walk-*", ("bearings",)),
    Site("ble51-uca-*", ("beam", "das"), still=True),
    Site("starloc-fast-*", ("uwb", "uwb-imu")),
    Site("starloc-2d-*", ("uwb",)),
    Site("lias-planar-*", ("uwb",), others="lias-still-*"),
    Site("rcv-drone-*", ("uwb",)),
    Site("iasl-drone-*", ("uwb", "uwb-imu", "fusion", "fix-kf")),
    Site("isas-walk-*", ("uwb", "uwb-imu")),
    Site("labyrinth*", ("uwb", "body", "trilateration-compensated")),
    # A straight path: in the line of sight, behind a wall, and obstructed.
    Site("ngbui-line-1-*", ("uwb", "line-grid")),
    Site("ngbui-line-2-*", ("uwb", "line-grid")),
    Site("ngbui-line-3-*", ("uwb", "line-grid")),
    # Late fixes of drones, which may be mirrored in the anchors' plane.
    Site("tiers-*", ("fix-mirror", "fix-kf")),
    # Range differences of a quadrotor, in a clear and in a cluttered room.
    Site("util-c1-*", ("tdoa",)),
    Site("util-c4-*", ("tdoa",)),
)
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
