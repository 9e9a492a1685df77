"""The types of the commands' values, and the options that several of them share; light, as help imports them."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter

if TYPE_CHECKING:
    from trackwright.trackers.recordings.calibration import Calibration
    from trackwright.trackers.recordings.folder import RecordingFolder, Selection
    from trackwright.trackers.recordings.named_tracker import NamedTracker
    from trackwright.tuning.tuned_file import Tuned


def _number(low: float, high: float = math.inf, words: str = "") -> Callable[[Any, Any], None]:
    """A validator, which refuses what is no finite number from `low` to `high`."""

    def check(_: Any, value: Any) -> None:
        if value is not None and not (low <= value <= high and math.isfinite(value)):
            raise ValueError(f"expected {words or f'at least {low:g}'}")

    return check


def _output(_: Any, path: Path | None) -> None:
    from trackwright.trackers.recordings.tracks_table import require_output

    if path is not None:
        require_output(path)


INPUT, TRACKER, OUTPUT, RUNNING, RARELY = (
    Group(name, sort_key=k) for k, name in enumerate(("Input", "Tracker", "Output", "Running", "Rarely needed"), 1)
)
"""The sections of help, after the parameters of the command alone."""

FLAG, RUN = Parameter(group=TRACKER), Parameter(group=RUNNING)
RARE = Parameter(group=RARELY, show="--help-all" in sys.argv)

Folder = Annotated[Path, Parameter(metavar="FOLDER")]
Out = Annotated[Path, Parameter(metavar="FOLDER", validator=_output, group=OUTPUT)]
Recording = Annotated[Path, Parameter(required=True)]  # one at least
File = Annotated[Path, Parameter(metavar="FILE")]
Seconds = Annotated[float, Parameter(metavar="S", validator=_number(-math.inf, words="seconds"))]
Span = Annotated[float, Parameter(metavar="S", validator=_number(0, 1e6, "seconds from 0 on"))]
Lag = Annotated[float, Parameter(metavar="S", group=TRACKER, validator=_number(1e-9, 1e6, "seconds above zero"))]
Seed = Annotated[int, Parameter(group=RUNNING, validator=_number(0, 2**64 - 1, "a whole number from 0 to 2^64 - 1"))]
Pattern = Annotated[str, Parameter(metavar="PATTERN")]
Name = Annotated[str, Parameter(metavar="NAME")]
Cluster = Annotated[str, Parameter(metavar="ADDRESS")]
Least1 = Annotated[int, Parameter(validator=_number(1))]
Figures = Annotated[Literal["none", "page", "png", "pdf"], Parameter(group=OUTPUT)]


@Parameter(name="*", group=INPUT)
@dataclass(frozen=True, kw_only=True)
class Part:
    """The part of recordings, or of estimates, that is used.

    Args:
        tag: these tags alone.
        from_: rows from this time on.
        to: rows up to this time.
    """

    tag: tuple[Annotated[str, Parameter(metavar="TAG")], ...] = ()
    from_: Seconds | None = None
    to: Seconds | None = None

    @property
    def part(self) -> Selection:
        """The part of each recording."""
        from trackwright.trackers.recordings.folder import Selection

        return Selection(self.tag, self.from_, self.to)


@Parameter(name="*", group=INPUT)
@dataclass(frozen=True, kw_only=True)
class Readings(Part):
    """The readings that are used, and their calibration.

    Args:
        calibration: a calibration.toml of `trackwright calibrate`, of other recordings of these stations or anchors.
        average: mean of readings over so many seconds; 0: every reading; default: 0.5 for bearings that repeat.
    """

    calibration: File | None = None
    average: Annotated[Span, RARE] | None = None

    def read_calibration(self) -> Calibration | None:
        """The calibration, None without one; raises UnusableInput."""
        if self.calibration is None:
            return None
        from trackwright.trackers.recordings.calibration import read_calibration

        return read_calibration(self.calibration)


@Parameter(name="*", group=TRACKER)
@dataclass(frozen=True, kw_only=True)
class Numbers:
    """The tracker and its numbers.

    Args:
        tracker: one that `trackwright trackers` lists, or FILE.py:NAME; default: as in the file --noise, else the one
            that fits the tables.
        noise: a tuned.toml of `trackwright tune`, from which `tune` starts.
        set_: values by tunable or pattern, e.g. sensors.ranges.sigma_r=0.1, before those of --noise.
        free_height: estimate the height of tags whose height the rig gives.
        side: where tags are of anchors in one plane; default: below from 2 m on, above up to 0.5 m, else either.
    """

    tracker: Name | None = None
    noise: File | None = None
    set_: tuple[Annotated[str, Parameter(metavar="NAME=VALUE")], ...] = ()
    free_height: Annotated[bool, RARE] = False
    side: Annotated[Literal["above", "below"], RARE] | None = None

    @cached_property
    def values(self) -> dict[str, Any]:
        """The values of `--set` by tunable or pattern; raises UnusableInput."""
        if not self.set_:
            return {}
        from trackwright.tuning.tuned_file import parse_values

        return parse_values(self.set_, "--set")

    @cached_property
    def tuned(self) -> Tuned | None:
        """The content of `--noise`; raises UnusableInput."""
        if self.noise is None:
            return None
        from trackwright.tuning.tuned_file import read_tuned

        return read_tuned(self.noise)

    @property
    def named(self) -> str | None:
        """The tracker that the options or the file name, None for the one that fits the tables."""
        return self.tracker or (None if self.tuned is None else self.tuned.tracker)

    def read(self) -> None:
        """Raises UnusableInput for values and files that cannot be read, before anything else is."""
        from trackwright.trackers.catalogue import run_file_of

        run_file_of(self.named)
        _ = self.values

    def build(self, name: str, folders: RecordingFolder | list[RecordingFolder]) -> NamedTracker:
        """The tracker of this name for recordings, with the values of the file and then of `--set`."""
        from trackwright.trackers.catalogue import build

        named = build(name, folders, self.free_height, self.side)
        if self.tuned is not None:
            named = self.tuned.of(named, self.noise)
        return named.with_values(self.values, "--set") if self.values else named


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class TrackOptions:
    """How it is tracked, and what is written.

    Args:
        out: the folder to write to.
        fit: fit noise levels to each recording's own readings, except where errors last or --noise or --set has them.
        smooth: use later readings too, all of them: for recordings, where nothing has to be known at once.
        lag: smooth with the readings of the next so many seconds only.
        seed: of the random numbers of particle filters.
        cluster: track one by one on a Dask cluster, tcp://HOST:8786, or in processes here, local:4.
        figures: page, report.html with playback and linked charts; png or pdf, also the charts as files; or none.
        force: track recordings in spite of the errors that `trackwright check` finds.
    """

    out: Out
    numbers: Numbers = field(default_factory=Numbers)
    used: Readings = field(default_factory=Readings)
    fit: Annotated[bool, FLAG] = False
    smooth: Annotated[bool, FLAG] = False
    lag: Lag | None = None
    seed: Seed = 0
    cluster: Annotated[Cluster, RARE] | None = None
    figures: Figures = "page"
    force: Annotated[bool, RUN] = False


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class TuneOptions:
    """What is fitted, how, and what is written.

    Args:
        out: the folder to write to.
        objective: state-nll or rmse (need truth), or nll; default: by the truth there is.
        tune: shell patterns of tunables, e.g. 'motion.*'; 'tied:PATTERN' keeps all matches equal. Default: the noise
            levels of motion and sensors; with truth the latency of fixes, else dof and skew of readings.
        freeze: patterns of tunables to keep.
        bound: physical bounds of tuned numbers.
        held_out: recordings to validate on: not fitted, they select the best point and end the fit.
        prior: of nll and state-nll: sites, the spread between sites about the values before the fit; or flat.
        starts: number of starts: the given values, then the best of a first guess from the data and a coarse grid.
        steps: maximum number of steps per start.
        resume: continue from the checkpoint in --out, with bit-identical results.
        figures: page, report.html; or none.
    """

    out: Out
    numbers: Numbers = field(default_factory=Numbers)
    used: Readings = field(default_factory=Readings)
    objective: Name | None = None
    tune: tuple[Pattern, ...] | None = None
    freeze: tuple[Pattern, ...] = ()
    bound: tuple[Annotated[str, Parameter(metavar="PATTERN=LOW:HIGH")], ...] = ()
    held_out: Annotated[tuple[Folder, ...], Parameter(group=INPUT)] = ()
    prior: Annotated[Literal["sites", "flat"], RARE] = "sites"
    starts: Annotated[Least1, RARE] = 4
    steps: Annotated[Least1, RARE] = 60
    resume: Annotated[bool, RUN] = False
    figures: Annotated[Literal["none", "page"], Parameter(group=OUTPUT)] = "page"


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """What is compared, and what is printed.

    Args:
        truth: recordings with truth, or a trajectory file of the one tag; default: the tracked recordings.
        align: fit each track to its truth first: se3, sim3 (with scale), scale, se2 (in x and y), origin (first pose).
        time_offset: added to the times of the estimates.
        time_tolerance: largest distance in time between a pose and its true pose.
        rpe: steps of the relative pose errors: 1m, 1s, 10f (rows); default: 1m 1s.
        json: print all metrics of a run as JSON instead of a table.
        fail_if: exit with code 1 if this holds for the overall metrics, e.g. "p95_m>0.5" or "rmse_m>0.2 or lost_s>0".
        allow_left_out: exit with code 0, not 3, where recordings of an archive are left out.
        out: a folder for the page that compares several runs.
    """

    truth: Annotated[tuple[Annotated[Path, Parameter(metavar="FOLDER|FILE")], ...], Parameter(group=INPUT)] = ()
    used: Part = field(default_factory=Part)
    align: Literal["none", "se2", "se3", "sim3", "scale", "origin"] | None = None
    time_offset: Seconds = 0.0
    time_tolerance: Annotated[Seconds, RARE] = 0.01
    rpe: tuple[Annotated[str, Parameter(metavar="STEP")], ...] = ()
    json: Annotated[bool, Parameter(group=OUTPUT)] = False
    fail_if: Annotated[str, Parameter(metavar="CONDITION", group=OUTPUT)] | None = None
    allow_left_out: Annotated[bool, Parameter(group=OUTPUT)] = False
    out: Out | None = None


def settings(options: TrackOptions | TuneOptions, **without: Any) -> str:
    """The options as text, for digests of what results depend on; `without`: defaults of those that do not."""
    return repr(replace(options, out=Path(), **without))
