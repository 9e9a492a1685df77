"""The trackers by name, which of them fits a recording, and how a user adds one by file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING

from trackwright.trackers.core.errors import UnusableInput, near
from trackwright.trackers.core.user_file import from_file, split_name
from trackwright.trackers.recordings.kinds import KINDS

if TYPE_CHECKING:  # shells complete the names of trackers, for which jax need not be imported
    from trackwright.trackers.recordings.folder import RecordingFolder
    from trackwright.trackers.recordings.named_tracker import NamedTracker
    from trackwright.trackers.recordings.tracker_spec import TrackerSpec

SYSTEMS = ("aoa", "line", "uwb_imu", "baselines", "mhk")
"""The packages whose `rows` have catalogue entries."""

PREFERENCE: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        # No recording: phases of one station alone.
        "phases of several stations": ("direct", "cascade"),
        # ble51-uca, six of them.
        "phases of a station": ("beam", "das"),
        "bearings": ("bearings",),
        # ngbui-line, all six.
        "readings along a known path": ("line-grid", "line-pf"),
        # lias-still, all three, and all of the others that are not the first of their kind. With an IMU the two of
        # ngbui-line-3, which it makes worse, outweigh the other four.
        "ranges": ("uwb", "uwb-imu", "multilateration", "trilateration", "trilateration-compensated"),
        # No recording with a floor plan.
        "fixes on a floor plan": ("floor-pf",),
        # iasl-drone and all of tiers: the first five are ties, and the simplest is the first.
        "fixes": ("fix-kf", "fix-singer", "imm", "mhk-stamped", "fix-mirror", "moving-average", "median", "mhk"),
    }
)
"""The trackers by kind of readings, in the order in which these are tried where none is named.

`python -m trackwright.experiments.lab.validation choice` finds the order within a kind by the errors on recordings on
which the levels of neither tracker were fitted, which are named above; docs/which-tracker.md has its figures.
"""


class _Catalogue(Mapping[str, "TrackerSpec"]):
    """The entries of all systems, in the order of preference; a system is imported when one of its entries is used."""

    def __getitem__(self, name: str) -> TrackerSpec:
        for entries in _entries():
            if name in entries:
                return entries[name]
        raise KeyError(name)

    def __iter__(self) -> Iterator[str]:
        for names in PREFERENCE.values():
            yield from names

    def __len__(self) -> int:
        return sum(len(names) for names in PREFERENCE.values())

    def __repr__(self) -> str:
        return f"<TRACKERS: {', '.join(self)}>"


def _entries() -> Iterator[dict[str, TrackerSpec]]:
    for system in SYSTEMS:
        yield import_module(f"trackwright.trackers.{system}.rows").TRACKERS


TRACKERS: Mapping[str, TrackerSpec] = _Catalogue()


def build(
    name: str, recordings: RecordingFolder | Sequence[RecordingFolder], free_height: bool = False
) -> NamedTracker:
    """The tracker of this name for recordings; `name` is one of the catalogue's or `FILE.py:NAME` of a `TrackerSpec`.

    `free_height`: estimate the height of tags even where rig.toml gives it. Raises UnusableInput for an unknown name
    and for a recording that lacks what the tracker reads.
    """
    from trackwright.trackers.recordings.named_tracker import NamedTracker

    return NamedTracker.of(name, spec_of(name), recordings, free_height)


def tracker_for(recordings: RecordingFolder | Sequence[RecordingFolder], free_height: bool = False) -> NamedTracker:
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
    for name, spec in TRACKERS.items():
        missing = spec.missing(folder)
        if missing is None and spec.automatic(folder):
            return name
        if nearest is None and missing is not None and spec.table in folder.tables:
            nearest = f"the nearest, '{name}', needs {missing}"
    needs = ", ".join(sorted({spec.table for spec in TRACKERS.values()} & set(KINDS)))
    raise UnusableInput(
        f"{folder.path or folder.name}: no tracker fits; {nearest or f'all need one of the tables {needs}'}; its "
        f"tables: {', '.join(folder.tables)}; see `trackwright trackers`"
    )


def spec_of(name: str) -> TrackerSpec:
    """The entry of a tracker by its name in the catalogue, or a user's own by `FILE.py:NAME`; raises UnusableInput."""
    if not isinstance(name, str):
        raise UnusableInput(f'tracker: found {type(name).__name__}; expected a name, as in build("uwb", recording)')
    if name in TRACKERS:
        return TRACKERS[name]
    if split_name(name)[0]:
        from trackwright.trackers.recordings.tracker_spec import TrackerSpec

        found: TrackerSpec = from_file(name, "tracker", "TrackerSpec", lambda x: isinstance(x, TrackerSpec))
        return found
    raise UnusableInput(
        f"tracker {name}: unknown{near(name, TRACKERS)}; expected FILE.py:NAME or one of {', '.join(TRACKERS)}"
    )
