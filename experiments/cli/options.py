"""The types of the commands' values, and the options that several of them share; light, as help imports them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

if TYPE_CHECKING:
    import numpy as np

    from trackwright.trackers.recordings.calibration import Calibration
    from trackwright.trackers.recordings.folder import Selection
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


Folder = Annotated[Path, Parameter(metavar="FOLDER")]
Out = Annotated[Path, Parameter(metavar="FOLDER", validator=_output)]
Recording = Annotated[Path, Parameter(required=True)]
"""One of the positional folders, of which a command needs one at least."""

File = Annotated[Path, Parameter(metavar="FILE")]
Seconds = Annotated[float, Parameter(metavar="S", validator=_number(-math.inf, words="seconds"))]
Pattern = Annotated[str, Parameter(metavar="PATTERN")]
Name = Annotated[str, Parameter(metavar="NAME")]
Address = Annotated[str, Parameter(metavar="ADDRESS")]
Least1 = Annotated[int, Parameter(validator=_number(1))]
Figures = Literal["none", "page", "png", "pdf"]

Alignment = Literal["none", "se2", "se3", "sim3", "scale", "origin"]
"""As `trackers.exchange.trajectories.Alignment`, which takes longer to import."""

OPTIONS = Parameter(name="*")  # decorates a dataclass whose fields are options, each explained in its docstring


@OPTIONS
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


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class Readings(Part):
    """The readings that are used, and their calibration.

    Args:
        calibration: a calibration.toml of `trackwright calibrate`, of other recordings of these stations or anchors.
        average: mean of readings over so many seconds; 0: every reading; default: 0.5 for bearings that repeat.
    """

    calibration: File | None = None
    average: Annotated[float, Parameter(metavar="S", validator=_number(0, words="seconds from 0 on"))] | None = None

    def read_calibration(self) -> Calibration | None:
        """The calibration, None without one; raises UnusableInput."""
        if self.calibration is None:
            return None
        from trackwright.trackers.recordings.calibration import read_calibration

        return read_calibration(self.calibration)


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class Numbers:
    """The tracker and its numbers.

    Args:
        tracker: one that `trackwright trackers` lists, or FILE.py:NAME; `track` compares several, with commas; default:
            as in the file `--noise` or `--start`, else the one that fits the tables.
        set_: values by tunable or pattern, e.g. sensors.ranges.sigma_r=0.1; `trackwright trackers NAME` lists them.
        free_height: estimate the height of tags whose height the rig gives.
        side: where tags are of anchors in one plane; default: below from 2 m on, above up to 0.5 m, else either.
    """

    tracker: Name | None = None
    set_: tuple[Annotated[str, Parameter(metavar="NAME=VALUE")], ...] = ()
    free_height: bool = False
    side: Literal["above", "below"] | None = None

    @cached_property
    def values(self) -> dict[str, Any]:
        """The values of `--set` by tunable or pattern; raises UnusableInput."""
        if not self.set_:
            return {}
        from trackwright.tuning.tuned_file import parse_values

        return parse_values(self.set_, "--set")


@dataclass(frozen=True, kw_only=True)
class WithNumbers:
    """Options with a tracker, its numbers, a tuned.toml in the field `noise` or `start`, and readings."""

    out: Out
    numbers: Numbers = field(default_factory=Numbers)
    used: Readings = field(default_factory=Readings)

    @property
    def file(self) -> Path | None:
        """The tuned.toml whose values are used."""
        file: Path | None = getattr(self, "noise", None) or getattr(self, "start", None)
        return file

    @cached_property
    def tuned(self) -> Tuned | None:
        """The content of that file; raises UnusableInput."""
        if self.file is None:
            return None
        from trackwright.tuning.tuned_file import read_tuned

        return read_tuned(self.file)

    @property
    def named(self) -> str | None:
        """The tracker that the options or the file name, None for the one that fits the tables."""
        return self.numbers.tracker or (None if self.tuned is None else self.tuned.tracker)

    def read(self) -> None:
        """Raises UnusableInput for values and files that cannot be read, before anything else is."""
        from trackwright.trackers.catalogue import run_files

        run_files(self.named)
        _ = self.numbers.values

    def valued(self, named: NamedTracker) -> NamedTracker:
        """The tracker with the values of the file and then of `--set`."""
        if self.tuned is not None:
            named = self.tuned.of(named, self.file)
        return named.with_values(self.numbers.values, "--set") if self.numbers.values else named

    def settings(self, **without: Any) -> str:
        """The options as text, for digests of what results depend on; `without`: defaults of those that do not."""
        return repr(replace(self, out=Path(), **without))


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class TrackOptions(WithNumbers):
    """How it is tracked, and what is written.

    Args:
        out: the folder to write to.
        noise: a tuned.toml of `trackwright tune`.
        fit: fit noise levels to each recording's own readings, except where errors last or --noise or --set has them.
        smooth: use later readings too, all of them: for recordings, where nothing has to be known at once.
        lag: smooth with the readings of the next so many seconds only.
        seed: of the random numbers of particle filters.
        cluster: track one by one on a Dask cluster, tcp://HOST:8786, or in processes here, local:4.
        figures: page, report.html with playback and linked charts; png or pdf, also the charts as files; or none.
        force: track recordings in spite of the errors that `trackwright check` finds.
        json: print the error metrics as JSON, by tracker, instead of tables.
    """

    noise: File | None = None
    fit: bool = False
    smooth: bool = False
    lag: Annotated[float, Parameter(metavar="S", validator=_number(1e-9, 1e6, "seconds above zero"))] | None = None
    seed: Annotated[int, Parameter(validator=_number(0, 2**64 - 1, "a whole number from 0 to 2^64 - 1"))] = 0
    cluster: Address | None = None
    figures: Figures = "page"
    force: bool = False
    json: bool = False


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class TuneOptions(WithNumbers):
    """What is fitted, how, and what is written.

    Args:
        out: the folder to write to.
        objective: state-nll or rmse (need truth), nll, or a sum as state-nll+0.1*rmse; default: by the truth there is.
        tune: shell patterns of tunables, e.g. 'motion.*'; 'tied:PATTERN' keeps all matches equal. Default: the noise
            levels of motion and sensors; with truth the latency of fixes, else dof and skew of readings.
        freeze: patterns of tunables to keep.
        bound: physical bounds of tuned numbers.
        prior: of nll and state-nll: sites, the spread between sites about the values before the fit; or flat.
        start: a tuned.toml to start from; --set goes before it.
        held_out: recordings to validate on: not fitted, they select the best point and end the fit.
        dimensions: 2 to judge the horizontal position, 3 to judge an estimated height too; default: by the truth.
        starts: number of starts: the given values, then the best of a coarse grid.
        steps: maximum number of steps per start.
        resume: continue from the checkpoint in --out, with bit-identical results.
        figures: page, report.html; png or pdf, also the chart of the objective as a file; or none.
    """

    objective: Name | None = None
    tune: tuple[Pattern, ...] | None = None
    freeze: tuple[Pattern, ...] = ()
    bound: tuple[Annotated[str, Parameter(metavar="PATTERN=LOW:HIGH")], ...] = ()
    prior: Literal["sites", "flat"] = "sites"
    start: File | None = None
    held_out: tuple[Folder, ...] = ()
    dimensions: Literal[2, 3] | None = None
    starts: Least1 = 4
    steps: Least1 = 60
    resume: bool = False
    figures: Figures = "page"


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class SweepOptions(WithNumbers):
    """What is evaluated, and where.

    Args:
        out: the folder to write to.
        over: a shell pattern of tunables, tied, and their values; once or twice. ':log' makes equal ratios.
        objective: rmse (needs truth), nll, or another objective of `tune`.
        dimensions: 2 to judge the horizontal position, 3 to judge an estimated height too.
        noise: a tuned.toml for the other parameters.
    """

    over: Annotated[tuple[str, ...], Parameter(metavar="PATTERN=START:STOP:COUNT[:log]...")]
    objective: Name = "rmse"
    dimensions: Literal[2, 3] = 2
    noise: File | None = None

    @cached_property
    def grids(self) -> dict[str, np.ndarray]:
        """The grids of `--over` by pattern; raises UnusableInput."""
        from trackwright.tuning.tuned_file import parse_grids

        return parse_grids(self.over, "--over")


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class PoseOptions:
    """The comparison of poses; None and empty where not given.

    Args:
        align: fit each track to its truth first: se3, sim3 (with scale), scale, se2 (in x and y), origin (first pose).
        time_offset: added to the times of the estimates.
        time_tolerance: largest distance in time between a pose and its true pose; default: 0.01.
        rpe: steps of the relative pose errors: 1m, 1s, 10f (rows); default: 1m 1s.
        out: a folder for the page, evaluation.json and the tracks as compared.
    """

    align: Alignment | None = None
    time_offset: Annotated[float, Parameter(metavar="S")] = 0.0
    time_tolerance: Seconds | None = None
    rpe: tuple[Annotated[str, Parameter(metavar="STEP")], ...] = ()
    out: Out | None = None


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """What is compared, and what is printed.

    Args:
        truth: recordings with truth, or a trajectory file of the one tag; default: the tracked recordings.
        json: print all metrics as JSON instead of a table.
        fail_if: exit with code 1 if this holds for the overall metrics, e.g. "p95_m>0.5" or "rmse_m>0.2 or lost_s>0".
    """

    truth: tuple[Annotated[Path, Parameter(metavar="FOLDER|FILE")], ...] = ()
    used: Part = field(default_factory=Part)
    json: bool = False
    fail_if: Annotated[str, Parameter(metavar="CONDITION")] | None = None
    poses: PoseOptions = field(default_factory=PoseOptions)


def file_format(figures: Figures) -> Literal["png", "pdf"] | None:
    """The kind of the figures in files, None for none."""
    return figures if figures == "png" or figures == "pdf" else None
