"""The types of the commands' values, and the options that several of them share; light, as help imports them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from trackwright.trackers.core.errors import UnusableInput, has_control

if TYPE_CHECKING:
    import numpy as np

    from trackwright.trackers.recordings.calibration import Calibration
    from trackwright.trackers.recordings.folder import RecordingFolder
    from trackwright.trackers.recordings.named_tracker import NamedTracker
    from trackwright.trackers.recordings.selection import Selection
    from trackwright.tuning.tuned_file import Tuned

Folder = Annotated[Path, Parameter(metavar="FOLDER")]
Recording = Annotated[Path, Parameter(required=True)]
"""One of the positional folders, of which a command needs one at least."""

File = Annotated[Path, Parameter(metavar="FILE")]
Seconds = Annotated[float, Parameter(metavar="S")]
Pattern = Annotated[str, Parameter(metavar="PATTERN")]
Setting = Annotated[str, Parameter(metavar="NAME=VALUE")]
Address = Annotated[str, Parameter(metavar="ADDRESS")]

FigureFormat = Literal["png", "pdf"]  # the kinds of figures in files, by their endings
Figures = Literal["none", "page", "png", "pdf"]


def _names_of_trackers(context: Any) -> list[str]:
    from trackwright.trackers.catalogue import ENTRIES

    return list(ENTRIES)


Tracker = Annotated[str, Parameter(metavar="NAME", completer=_names_of_trackers)]

Alignment = Literal["none", "se2", "se3", "sim3", "scale", "origin"]
"""As `trackers.exchange.pose_errors.Alignment`, which takes longer to import."""

FORM = "PATTERN=START:STOP:COUNT, as 'motion.sigma_a=0.01:1:100', with ':log' at the end for equal ratios"

OPTIONS = Parameter(name="*")  # decorates a dataclass whose fields are options, each explained in its docstring


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class PartOptions:
    """The options on the part of recordings, or of estimates, that is used.

    Raises UnusableInput for times that name no part of a recording.

    Args:
        tag: these tags alone.
        from_: rows from this time on.
        to: rows up to this time.
    """

    tag: tuple[Annotated[str, Parameter(metavar="TAG")], ...] = ()
    from_: Seconds | None = None
    to: Seconds | None = None

    def __post_init__(self) -> None:
        for option, value in (("--from", self.from_), ("--to", self.to)):
            if value is not None and not math.isfinite(value):
                raise UnusableInput(f"{option} {value:.12g}: expected seconds, a time of the recording")
        if self.from_ is not None and self.to is not None and self.from_ >= self.to:
            raise UnusableInput(f"--from {self.from_:.12g} --to {self.to:.12g}: expected the first below the second")

    @property
    def part(self) -> Selection:
        """The part of each recording."""
        from trackwright.trackers.recordings.selection import Selection

        return Selection(self.tag, self.from_, self.to)


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class ReadingOptions(PartOptions):
    """The options of `track`, `tune` and `sweep` on the readings that are used, and on their calibration.

    Args:
        calibration: a calibration.toml of `trackwright calibrate`, of other recordings of these stations or anchors.
        average: mean of the ranges, fixes or bearings of each tag and anchor or station over so many seconds; 0:
            every reading; default: 0.5 for bearings that repeat.
    """

    calibration: File | None = None
    average: Seconds | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.average is not None and not 0 <= self.average < math.inf:
            raise UnusableInput(f"--average {self.average:g}: expected seconds above zero, or 0 for every reading")

    def read_calibration(self) -> Calibration | None:
        """The calibration, None without; raises UnusableInput as `trackers.recordings.calibration`."""
        if self.calibration is None:
            return None
        from trackwright.trackers.recordings.calibration import read_calibration

        return read_calibration(self.calibration)


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class TrackerOptions:
    """The options of `track`, `tune` and `sweep` on the tracker and its numbers, and where they write to.

    Args:
        out: the folder to write to.
        tracker: one that `trackwright trackers` lists, or FILE.py:NAME of a TrackerSpec of your own; `track` compares
            several, with commas; default: as in the file `--noise` or `--start`, else the one that fits the tables.
        set_: values by tunable or pattern, e.g. sensors.ranges.sigma_r=0.1; `trackwright trackers NAME` lists them.
        free_height: estimate the height of tags whose height the rig gives.
        side: where tags are of anchors in one plane; default: below from 2 m on, above up to 0.5 m, else either.
    """

    out: Folder
    tracker: Tracker | None = None
    set_: tuple[Setting, ...] = ()
    free_height: bool = False
    side: Literal["above", "below"] | None = None
    used: ReadingOptions = field(default_factory=ReadingOptions)

    def __post_init__(self) -> None:
        require_output(self.out)

    @property
    def file(self) -> Path | None:
        """A tuned.toml, whose values are used: of `--noise` or `--start`."""
        file: Path | None = getattr(self, "noise", None) or getattr(self, "start", None)
        return file

    @cached_property
    def tuned(self) -> Tuned | None:
        """The content of that file; raises UnusableInput."""
        if self.file is None:
            return None
        from trackwright.tuning.tuned_file import read_tuned

        return read_tuned(self.file)

    @cached_property
    def values(self) -> dict[str, Any]:
        """Those of `--set` by tunable or pattern; raises UnusableInput."""
        if not self.set_:
            return {}
        from trackwright.tuning.tuned_file import parse_values

        return parse_values(self.set_, "--set")

    def read(self) -> None:
        """Raises UnusableInput for values and files that cannot be read, before anything else is."""
        run_tracker_files(self.tracker or (None if self.tuned is None else self.tuned.tracker))
        _ = self.values

    def valued(self, named: NamedTracker) -> NamedTracker:
        """The tracker with the values of the file and then of `--set`."""
        if self.tuned is not None:
            named = self.tuned.of(named, self.file)
        return named.with_values(self.values, "--set") if self.values else named

    def config(self, *without: str) -> dict[str, Any]:
        """The options as a manifest holds them, without those that change no result: what is written, and these."""
        silent = {"out", "set_", "used", "figures", "json", *without}
        fields = {name: getattr(self, name) for name in self.__dataclass_fields__ if name not in silent}
        used = {"calibration": self.used.calibration, "part": asdict(self.used.part), "average": self.used.average}
        return fields | {"set": self.set_} | used


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class TrackOptions(TrackerOptions):
    """How it is tracked, and what is written.

    Args:
        noise: a tuned.toml of `trackwright tune`.
        fit: fit noise levels and shape of errors to each recording's own readings; values of --noise, --set stay, and
            all where errors last, which readings alone do not tell from motion.
        smooth: use later readings too, all of them: for recordings, where nothing has to be known at once.
        lag: smooth with the readings of the next so many seconds only.
        seed: of the random numbers of particle filters.
        cluster: track each recording by itself, as --keep-going does, on a Dask cluster, tcp://HOST:8786, or in
            processes here, local:4.
        figures: page, report.html with playback and linked charts; png or pdf, also the charts as files; or none.
        force: track recordings in spite of the errors that `trackwright check` finds.
        keep_going: track each recording by itself, keep finished ones for the same command again, and leave out those
            that fail, with exit code 3; always with a folder of folders, more than 60 recordings, or --cluster.
        json: print the error metrics as JSON, by tracker, instead of tables.
    """

    noise: File | None = None
    fit: bool = False
    smooth: bool = False
    lag: Seconds | None = None
    seed: int = 0
    cluster: Address | None = None
    figures: Figures = "page"
    force: bool = False
    keep_going: bool = False
    json: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lag is not None and not 0 < self.lag < 1e6:
            raise UnusableInput(
                f"--lag {self.lag:g}: expected seconds above zero; without it the whole recording is used"
            )
        if not 0 <= self.seed < 2**64:
            raise UnusableInput(f"--seed {self.seed}: expected a whole number from 0 to 2^64 - 1")

    def applied(
        self, named: NamedTracker, folders: Sequence[RecordingFolder], advance: Callable[[int], None]
    ) -> tuple[list[tuple[NamedTracker, Sequence[RecordingFolder]]], list[str]]:
        """The trackers `valued`, fitted and smoothed as asked for, and what each runs on; a line for each fit."""
        named, lines = self.valued(named), list[str]()
        parts: list[tuple[NamedTracker, Sequence[RecordingFolder]]] = [(named, folders)]
        if self.fit:
            from trackwright.tuning.own_levels import fitted

            parts = []
            for folder in folders:
                own = fitted(named, folder)
                parts.append((own.tracker, [folder]))
                lines.append(own.line)
                advance(1)
        smooth = self.smooth or self.lag is not None
        return [(each.smoothing(self.lag) if smooth else each, of) for each, of in parts], lines

    def manifest(self, tracker: str) -> dict[str, Any]:
        """What the manifest of a run of this tracker holds of the options."""
        return self.config("cluster", "force", "keep_going") | {"tracker": tracker, "set": self.values}


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class TuneOptions(TrackerOptions):
    """What is fitted, how, and what is written.

    Args:
        objective: state-nll, the negative log density of the truth under the reported position and covariance, or rmse,
            which need truth; nll, the negative log-likelihood, which needs none; or a sum, e.g. state-nll+0.1*rmse.
            Default: state-nll where there is truth, else nll.
        tune: shell patterns of tunables, e.g. 'motion.*'; 'tied:PATTERN' keeps all matches equal. Default: the noise
            levels of motion and sensors; with truth the latency of fixes, else dof and skew of readings.
        freeze: patterns of tunables to keep.
        bound: physical bounds of tuned numbers.
        prior: of nll and state-nll: sites, by which values that the recordings tell little of stay near those before
            the fit, as sites differ; or flat.
        start: a tuned.toml to start from; --set goes before it.
        held_out: recordings to validate on: not fitted, they select the best point and end the fit.
        dimensions: 2 to judge the horizontal position, 3 to judge an estimated height too. Default: 3 for state-nll, in
            which a height counts half a horizontal coordinate, where the truth has heights and anchors' heights differ
            by more than 1 m; else 2.
        weigh: recordings or rows: which of them have the same weight.
        starts: number of starts: the given values, then the best of a first guess from the data and a coarse grid.
        optimiser: auto: lbfgs for nll and state-nll, alone or in a sum; adam else, and for particles.
        steps: maximum number of steps per start.
        resume: continue from the checkpoint in --out, with bit-identical results.
        cluster: hold the rows on the workers of a Dask cluster, tcp://HOST:8786, or of processes here, local:4, which
            all see the folder --out; for recordings that no memory holds, with the same tuned.toml.
        piece_rows: rows of the segments into which long recordings are cut.
        check: exit code 1 where the verdict is worse: the log density of true positions of left-out recordings fell.
        figures: page, report.html; png or pdf, also the chart of the objective as a file; or none.
        json: print the content of tuned.toml as JSON instead of tables.
    """

    objective: Annotated[str, Parameter(metavar="NAME")] | None = None
    tune: tuple[Pattern, ...] | None = None
    freeze: tuple[Pattern, ...] = ()
    bound: tuple[Annotated[str, Parameter(metavar="PATTERN=LOW:HIGH")], ...] = ()
    prior: Literal["sites", "flat"] = "sites"
    start: File | None = None
    held_out: tuple[Folder, ...] = ()
    dimensions: Literal[2, 3] | None = None
    weigh: Literal["recordings", "rows"] = "recordings"
    starts: int = 4
    optimiser: Literal["auto", "lbfgs", "adam"] = "auto"
    steps: int = 60
    resume: bool = False
    cluster: Address | None = None
    piece_rows: int = 8000
    check: bool = False
    figures: Figures = "page"
    json: bool = False

    def __post_init__(self) -> None:
        require_least(steps=(self.steps, 1), starts=(self.starts, 1), piece_rows=(self.piece_rows, 10))
        super().__post_init__()


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class SweepOptions(TrackerOptions):
    """What is evaluated, and where.

    Args:
        over: a shell pattern of tunables, tied, and their values; once or twice. ':log' makes equal ratios.
        objective: rmse (needs truth), nll, or another objective of `tune`.
        dimensions: 2 to judge the horizontal position, 3 to judge an estimated height too.
        weigh: recordings or rows: which of them have the same weight.
        repeats: runs of a particle filter per value, with different random numbers.
        noise: a tuned.toml for the other parameters.
        figures: kind of the figure, sweep.png or sweep.pdf.
        json: print the best point as JSON instead of a line.
    """

    over: Annotated[tuple[str, ...], Parameter(metavar="PATTERN=START:STOP:COUNT[:log]...")]
    objective: Annotated[str, Parameter(metavar="NAME")] = "rmse"
    dimensions: Literal[2, 3] = 2
    weigh: Literal["recordings", "rows"] = "recordings"
    repeats: int = 10
    noise: File | None = None
    figures: FigureFormat = "png"
    json: bool = False

    def __post_init__(self) -> None:
        require_least(repeats=(self.repeats, 1))
        super().__post_init__()

    @cached_property
    def grids(self) -> Mapping[str, np.ndarray]:
        """The grids of `--over` by pattern; raises UnusableInput."""
        import numpy as np

        if not 1 <= len(self.over) <= 2:
            raise UnusableInput(f"--over given {len(self.over)} times: expected once or twice; sweep others separately")
        grids = {}
        for text in self.over:
            pattern, _, span = text.rpartition("=")
            span, log = span.removesuffix(":log"), span.endswith(":log")
            try:
                start, stop, count = (kind(x) for kind, x in zip((float, float, int), span.split(":"), strict=True))
            except ValueError as error:
                raise UnusableInput(f"--over {text}: expected {FORM}") from error
            if not pattern or not -np.inf < start < stop < np.inf or count < 2:
                raise UnusableInput(f"--over {text}: expected {FORM}, START below STOP and COUNT at least 2")
            if pattern in grids:
                raise UnusableInput(f"--over {pattern}: duplicate, expected two different patterns")
            if log and start <= 0:
                raise UnusableInput(f"--over {text}: expected START above zero for equal ratios")
            grids[pattern] = (np.geomspace if log else np.linspace)(start, stop, count)
        return grids


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class PoseOptions:
    """The options of the comparison of poses; None and empty where they were not given.

    Args:
        align: fit each track to its truth first: se3, sim3 (with scale), scale, se2 (in x and y), origin (first pose).
        time_offset: added to the times of the estimates; auto: the one that fits best.
        time_tolerance: largest distance in time between a pose and its true pose; default: 0.01.
        rpe: steps of the relative pose errors: 1m, 1s, 10f (rows); default: 1m 1s.
        all_pairs: relative pose errors from every pose, not from the end of the step before.
        out: a folder for the page, evaluation.json and the tracks as compared.
    """

    align: Alignment | None = None
    time_offset: Annotated[str, Parameter(metavar="S|auto")] | None = None
    time_tolerance: Seconds | None = None
    rpe: tuple[Annotated[str, Parameter(metavar="STEP")], ...] = ()
    all_pairs: bool = False
    out: Folder | None = None

    @property
    def given(self) -> bool:
        """Whether any was given."""
        return self != PoseOptions()

    @property
    def offset(self) -> float | Literal["auto"]:
        """The time offset, s; raises UnusableInput for another text."""
        if self.time_offset in (None, "auto"):
            return 0.0 if self.time_offset is None else "auto"
        try:
            seconds = float(self.time_offset or "")
        except ValueError:
            seconds = math.nan
        if not math.isfinite(seconds):
            raise UnusableInput(f"--time-offset {self.time_offset}: expected seconds, or auto")
        return seconds


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """What is compared, and what is printed.

    Args:
        truth: recordings whose truth tables are used, or a trajectory file, of the one tag that the estimates follow;
            default: the tracked recordings.
        json: print all metrics as JSON instead of a table.
        fail_if: exit with code 1 if this holds for the overall metrics, e.g. "p95_m>0.5" or "rmse_m>0.2 or lost_s>0".
        cluster: score each recording of an archive on a Dask cluster, tcp://HOST:8786, or in processes here, local:4.
    """

    truth: tuple[Annotated[Path, Parameter(metavar="FOLDER|FILE")], ...] = ()
    used: PartOptions = field(default_factory=PartOptions)
    json: bool = False
    fail_if: Annotated[str, Parameter(metavar="CONDITION")] | None = None
    cluster: Address | None = None
    poses: PoseOptions = field(default_factory=PoseOptions)


def file_format(figures: Figures) -> FigureFormat | None:
    """The kind of the figures in files, None for none."""
    return figures if figures == "png" or figures == "pdf" else None


def run_tracker_files(trackers: str | None) -> None:
    """Runs the users' files among trackers, separated by commas: they may add the kinds of the recordings' tables."""
    from trackwright.trackers.catalogue import spec_of
    from trackwright.trackers.core.user_file import split_name

    for name in (trackers or "").split(","):
        if Path(split_name(name)[0]).is_file():
            spec_of(name)


def require_output(path: Path) -> None:
    """Raises UnusableInput for a folder that takes no results: a recording, a file, or the root of the file system."""
    if (path / "rig.toml").exists():
        # polars takes a while to import, which a command without such a folder need not wait for.
        from trackwright.trackers.recordings.kinds import table_kinds
        from trackwright.trackers.recordings.table_file import SUFFIXES

        if any((path / f"{table}{suffix}").exists() for table in table_kinds() for suffix in SUFFIXES):
            raise UnusableInput(f"--out {path}: is a recording folder; expected a folder for results; choose another")
    if path.resolve() == Path(path.resolve().anchor):
        raise UnusableInput(f"--out {path}: is the root of the file system; choose another folder")
    if has_control(str(path)):
        raise UnusableInput(f"--out {path}: has a control character or bytes that are no UTF-8; choose another folder")
    if path.is_file():
        raise UnusableInput(f"--out {path}: is a file; expected a folder for results; choose another folder")


def require_new(out: Path, name: str, force: bool) -> None:
    """Raises UnusableInput for a file that is no .toml, as `name`, or that exists and is not to be replaced."""
    if out.suffix != ".toml" or out.is_dir():
        raise UnusableInput(f"--out {out}: expected a file with the ending .toml; give {name} in a folder")
    if out.exists() and not force:
        raise UnusableInput(f"--out {out}: exists; expected a new file; --force replaces it")
    require_output(out.parent)


def require_least(**counts: tuple[int | None, int]) -> None:
    """Raises UnusableInput for the first option, of those with a value and the least one, that is below it."""
    for name, (value, least) in counts.items():
        if value is not None and value < least:
            raise UnusableInput(f"--{name.replace('_', '-')} {value}: expected at least {least}")
