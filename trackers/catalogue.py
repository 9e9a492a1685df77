"""The trackers by name, which of them fits a recording, and how a user adds one by file."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from trackwright.trackers.core.errors import UnusableInput, near
from trackwright.trackers.core.on_demand import from_file, split_name

# Lists and shells have the names of trackers, for which neither jax nor polars need be imported.
if TYPE_CHECKING:
    from trackwright.trackers.recordings.folder import RecordingFolder
    from trackwright.trackers.recordings.named_tracker import NamedTracker, Recordings, TrackerSpec


class Entry(NamedTuple):
    """What lists say of a tracker before its system is imported: its module, what it reads, and a line."""

    module: str
    table: str
    about: str

    def may_fit(self, folder: RecordingFolder) -> bool:
        """Whether the folder has a table of those that it reads, or two, and a known path if it needs one."""
        tables = folder.tables.keys() & re.findall(r"\w+", self.table)
        enough = len(tables) >= (2 if self.table.startswith("two") else 1)
        return enough and ("[path]" not in self.table or folder.rig.path_knots is not None)


_CIRCLES = "planar position from three ranges, intersection of circles"
_BY_SYSTEM: Sequence[tuple[str, str, Mapping[str, str]]] = (
    # Phases of several stations, then of one. No recording: phases of one station alone; beam: ble51-uca, six of them.
    ("aoa.rows", "phases", {
        "direct": "position from the phases of all stations in one EKF, spherical waves",
        "cascade": "3-D position from phases, a beam tracker per station, then bearings-only fusion (Will et al.)",
        "beam": "azimuth and elevation per station from phases, EKF (Will et al.)",
        "das": "azimuth and elevation per station from phases, delay-and-sum on each row without a filter",
    }),
    # Several kinds of readings. No recording with two kinds that are independent.
    ("fusion.rows", "two or more of ranges, tdoa, bearings and fixes", {
        "fusion": "position from ranges, range differences, bearings and fixes in one EKF, with the biases of each "
        "kind",
    }),
    ("aoa.rows", "bearings", {"bearings": "position from azimuths and elevations of any number of stations, EKF"}),
    # Readings along a known path: ngbui-line, all six.
    ("line.rows", "ranges or fixes, and [path]", {
        "line-grid": "position on a known path from ranges or fixes, grid filter of arclength and speed",
        "line-pf": "position on a known path from ranges or fixes, particle filter with 1,000 particles (thesis)",
    }),
    # Ranges: lias-still, all three, and all of the others that are not the first of their kind. With an IMU the two of
    # ngbui-line-3, which it makes worse, outweigh the other four.
    ("uwb_imu.rows", "ranges", {"uwb": "position from ranges, EKF with a drifting bias per anchor"}),
    ("uwb_imu.body_rows", "ranges and odometry", {
        "body": "position and heading of a body from the ranges of its tags, and from its odometry if any, EKF",
    }),
    ("uwb_imu.body_rows", "ranges and imu", {
        "uwb-imu": "position, velocity and attitude from ranges and an IMU, error-state EKF",
    }),
    ("uwb_imu.snapshots", "ranges", {
        "multilateration": "position from the latest ranges, robust least squares without a filter",
        "trilateration": f"{_CIRCLES} (Kwon et al.) without compensation (14)",
        "trilateration-compensated": f"{_CIRCLES} with compensation (14) (Kwon et al.)",
    }),
    # Range differences: the three of util.
    ("uwb_imu.difference_rows", "tdoa", {
        "tdoa": "position from range differences, EKF with a drifting bias per anchor",
    }),
    ("uwb_imu.body_rows", "tdoa and imu", {
        "tdoa-imu": "position, velocity and attitude from range differences and an IMU, error-state EKF",
    }),
    # Fixes on a floor plan: no recording.
    ("baselines.rows", "fixes, and [floor]", {
        "floor-pf": "position from fixes on a floor with walls, particle filter with 1,000 particles",
    }),
    # Fixes: iasl-drone and all of tiers: the first five are ties, and the simplest is the first.
    ("baselines.rows", "fixes", {
        "fix-kf": "position from fixes, Kalman filter, constant velocity in x and y",
        "fix-singer": "position from fixes, Kalman filter, Singer's acceleration model",
        "imm": "position from fixes, IMM filter of three constant-velocity models",
    }),
    ("mhk.rows", "fixes", {"mhk-stamped": "mhk, with each estimate at the time of the middle of its median window"}),
    ("baselines.rows", "fixes", {
        "fix-mirror": "position from fixes whose z may be mirrored in the anchors' plane, IMM filter of both sides",
        "moving-average": "mean of the last 9 fixes, axis by axis",
        "median": "median of the last 9 fixes, axis by axis",
    }),
    ("mhk.rows", "fixes", {
        "mhk": "position from fixes: sliding median, hidden Markov model of accelerations, Kalman filter "
        "(Huang et al.)",
    }),
)  # fmt: skip
ENTRIES = {name: Entry(module, table, about) for module, table, group in _BY_SYSTEM for name, about in group.items()}
"""The trackers by kind of readings, in the order in which these are tried where none is named.

The order within a kind is by the errors on recordings on which the levels of neither tracker were fitted, named above.
"""


class _Catalogue(Mapping[str, "TrackerSpec"]):
    """The trackers in the order of preference; the system of one is imported when it is used."""

    def __getitem__(self, name: str) -> TrackerSpec:
        return _completed(name, ENTRIES[name])

    def __iter__(self) -> Iterator[str]:
        return iter(ENTRIES)

    def __len__(self) -> int:
        return len(ENTRIES)

    def __repr__(self) -> str:
        return f"<TRACKERS: {', '.join(self)}>"


@functools.cache
def _completed(name: str, entry: Entry) -> TrackerSpec:
    """What its module has of the tracker, with what lists say of it."""
    module = import_module(f"trackwright.trackers.{entry.module}")
    return module.TRACKERS[name](about=entry.about, table=entry.table)  # type: ignore[no-any-return]


TRACKERS: Mapping[str, TrackerSpec] = _Catalogue()


def build(name: str, recordings: Recordings, free_height: bool = False, side: str | None = None) -> NamedTracker:
    """The tracker of this name for recordings; `name` is one of the catalogue's or `FILE.py:NAME` of a `TrackerSpec`.

    `free_height`: estimate the height of tags even where rig.toml gives it. `side`: above or below, where the tags are
    of anchors in one plane. Raises UnusableInput for an unknown name and where the recording lacks what is read.
    """
    from trackwright.trackers.recordings.named_tracker import NamedTracker

    return NamedTracker.of(name, spec_of(name), recordings, free_height, side)


def tracker_for(recordings: Recordings, free_height: bool = False) -> NamedTracker:
    """The tracker that fits the tables of the (first) recording, as `trackwright track` chooses it.

    Raises UnusableInput where none fits.
    """
    from trackwright.trackers.recordings.named_tracker import folder_list

    folders = folder_list(recordings)
    return build(fitting(folders[0]), folders, free_height)


def fitting(folder: RecordingFolder) -> str:
    """The name of the tracker that fits the folder's tables.

    Raises UnusableInput where none does, with what the folder lacks for the first one that reads a table of its own.
    """
    nearest = None
    for name, entry in ENTRIES.items():
        if not entry.may_fit(folder):
            continue
        spec = TRACKERS[name]
        missing = spec.missing(folder)
        if missing is None and spec.automatic(folder):
            return name
        if nearest is None and missing is not None and entry.table in folder.tables:
            nearest = f"the nearest, '{name}', needs {missing}"
    needs = ", ".join(sorted({entry.table for entry in ENTRIES.values() if entry.table.isalpha()}))
    raise UnusableInput(
        f"{folder.path or folder.name}: no tracker fits; {nearest or f'all need one of the tables {needs}'}; its "
        f"tables: {', '.join(folder.tables)}; see `trackwright trackers`"
    )


def run_file_of(tracker: str | None) -> None:
    """Runs the user's file of a tracker, if it has one: it may add the kinds of the recordings' tables."""
    if tracker is not None and Path(split_name(tracker)[0]).is_file():
        spec_of(tracker)


def spec_of(name: str) -> TrackerSpec:
    """The entry of a tracker by its name in the catalogue, or a user's own by `FILE.py:NAME`; raises UnusableInput."""
    if not isinstance(name, str):
        raise UnusableInput(f'tracker: found {type(name).__name__}; expected a name, as in build("uwb", recording)')
    if name in TRACKERS:
        return TRACKERS[name]
    if split_name(name)[0]:
        from trackwright.trackers.recordings.named_tracker import TrackerSpec

        return from_file(name, "tracker", "TrackerSpec", lambda x: isinstance(x, TrackerSpec))
    if "," in name:
        raise UnusableInput(
            f"tracker {name}: found {name.count(',') + 1} names; expected one; `evaluate A B` compares runs"
        )
    raise UnusableInput(
        f"tracker {name}: unknown{near(name, TRACKERS)}; expected FILE.py:NAME or one of {', '.join(TRACKERS)}"
    )
