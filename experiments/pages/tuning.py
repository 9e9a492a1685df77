"""A fit as tables, curves and one page: its verdict, what it changed, and what the recordings do not determine."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from markupsafe import Markup

from trackwright.experiments.pages.chart import BLUE, LINES, PALE, VERMILION, Chart, Line, band, is_logarithmic, write
from trackwright.experiments.pages.report import report_page
from trackwright.experiments.text.tables import Section, sections_text
from trackwright.experiments.text.wording import MISSING, SHOWN, duration, fixed, length_unit, number, yes_no
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.comparison import Difference, paired_means
from trackwright.trackers.evaluation.evaluate import Evaluation, with_truth
from trackwright.trackers.evaluation.statements import covariance_statements
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.trackers.recordings.trajectories import Trajectory
from trackwright.tuning.data import FitData
from trackwright.tuning.fit_warnings import Issue
from trackwright.tuning.fitting import FitResult
from trackwright.tuning.parameters import component_names
from trackwright.tuning.sweeping import Sweep
from trackwright.tuning.uncertainty import Interval

OBJECTIVES = {
    "nll": "negative log-likelihood per measured number (nats)",
    "rmse": "RMSE ({})",
    "rmse-3d": "3-D RMSE ({})",
    "state-nll": "negative log-likelihood of the truth per row (nats)",
}
"""The objectives in words, for the unit of the truth."""

Pair = tuple[float | None, float | None]


class Verdict(NamedTuple):
    """Whether left-out recordings got better.

    `change`: of the mean log density of the true position, nats, all recordings with the same weight; None where it
    cannot be judged, for the reason `why_not`. `recordings`: the same of each.
    """

    change: Difference | None
    recordings: Mapping[str, Difference]
    why_not: str = ""

    @property
    def word(self) -> str:
        """The verdict in a word or two."""
        if self.change is None:
            return "not judged"
        return "better" if self.change.low > 0 else "worse" if self.change.high < 0 else "not told apart"

    def sentence(self, about: str) -> str:
        """What the verdict is by; `about`: in words, the recordings."""
        if self.change is None:
            return f"{self.why_not[0].upper()}{self.why_not[1:]}."
        return f"Mean log density of the true position, {about}: {_changed(self.change)}."

    @property
    def got_worse(self) -> list[str]:
        """A sentence for each recording that got worse."""
        worse = {name: d for name, d in self.recordings.items() if d.value < 0 and not d.high >= 0}
        return [f"{name} got worse, {_changed(difference)}." for name, difference in worse.items()]


def _changed(change: Difference) -> str:
    interval = f"95 % interval {change.low:+.2f} to {change.high:+.2f}"
    if not np.isfinite(change.low):
        interval = f"no interval: too short, {counted(change.pieces, 'piece')} of time longer than errors last"
    return f"{change.first:.2f} → {change.second:.2f} nats, {change.value:+.2f} ({interval})"


def _content(change: Difference | None) -> dict[str, Any]:
    if change is None:
        return {}
    named = {"before": change.first, "after": change.second, "low_95": change.low, "high_95": change.high}
    return {"log_density": {name: float(f"{value:.6g}") for name, value in named.items()}}


def judge(sides: Sequence[pl.DataFrame], dimensions: int) -> Verdict:
    """The verdict on the estimates of left-out recordings before and after, of the same rows."""
    densities = [float_column(side, "density_3d" if dimensions == 3 else "density") for side in sides]
    known = np.isfinite(densities).all(axis=0)
    if not known.any():
        return Verdict(None, {}, "no estimate has both a covariance and a truth")
    names = sides[0]["recording"].to_numpy()[known]
    given = float_column(sides[0], "t_s")[known], *(x[known] for x in densities), names
    return Verdict(
        paired_means(*given), {str(x): paired_means(*(of[names == x] for of in given)) for x in np.unique(names)}
    )


class Compared(NamedTuple):
    """Recordings before and after tuning: their table, with sentences on the covariances after it, and the verdict.

    `about`: in words, the recordings. `metrics`: of each recording by name, before and after.
    """

    about: str
    section: Section
    verdict: Verdict
    metrics: Mapping[str, Mapping[str, Pair]] = {}

    def text(self) -> str:
        """The table, the sentences and the verdict for a terminal."""
        verdict = f"Verdict: {self.verdict.word}. {self.verdict.sentence(self.about)}"
        return sections_text([self.section], 120, *self.section.parts, verdict, *self.verdict.got_worse)

    def content(self) -> dict[str, Any]:
        """The verdict and the table as tuned.toml holds them, nan for what is unknown."""
        recordings = {
            name: {key: [math.nan if x is None else float(f"{x:.6g}") for x in pair] for key, pair in metrics.items()}
            | _content(self.verdict.recordings.get(name))
            for name, metrics in self.metrics.items()
        }
        head = {"verdict": self.verdict.word, "judged_by": self.about}
        return head | _content(self.verdict.change) | {"recordings": recordings}


def tracked(tracker: NamedTracker, folders: Sequence[RecordingFolder]) -> pl.DataFrame:
    """The estimates of the recordings, tracked as `track` does it, with their truth."""
    return with_truth(tracker.run(folders).table, folders)


def compare(
    sides: Sequence[pl.DataFrame], folders: Sequence[RecordingFolder], dimensions: int, about: str, why_not: str = ""
) -> Compared:
    """Errors of the recordings `folders` in the estimates before and after tuning, those of `tracked`.

    `dimensions`: 3 for errors and ellipsoids in space. `about`: in words, the recordings. `why_not`: why there is no
    verdict. A recording without truth has no figures but those of its innovations.
    """
    sides = [side.filter(pl.col("recording").is_in([folder.name for folder in folders])) for side in sides]
    before, after = map(Evaluation.of, sides)
    suffix = "_3d" if dimensions == 3 and before.overall.get("coverage_95_3d") is not None else ""
    error = "rmse_direction_rad" if before.bearing else f"rmse{suffix}_m"
    unit = SHOWN["rad"] if before.bearing else length_unit(before.overall[error] or 1.0)
    columns = {
        f"{'3-D ' if suffix else ''}RMSE, {unit.name}": (error, unit.factor, 3 if unit.name == "m" else 1),
        f"% in 95 % {'ellipsoid' if suffix else 'ellipse'}": (f"coverage_95{suffix}", 100.0, 0),
        "NEES/dof": (f"nees{suffix}_ratio", 1.0, 2),
        "regret": (f"regret{suffix}", 1.0, 2),
        "NIS/dof": ("nis_ratio", 1.0, 2),
    }
    keys = [key for key, _, _ in columns.values()]
    pairs = [*zip(before.recordings, after.recordings, strict=True)]
    verdict = Verdict(None, {}, why_not) if why_not else judge(sides, 3 if suffix else 2)
    shown = [(old["recording"], old, new, verdict.recordings.get(old["recording"])) for old, new in pairs]
    if len(pairs) > 1:
        # Each with the same weight; none where a recording has no value.
        means = pl.col(keys).cast(pl.Float64).fill_null(np.nan).mean()
        sides_of = (pl.DataFrame(of, infer_schema_length=None) for of in (before.recordings, after.recordings))
        old, new = (table.select(means).row(0, named=True) for table in sides_of)
        shown.append((f"mean of {len(pairs)}", old, new, verdict.change))
    rows = []
    for name, old, new, change in shown:
        cells = [
            " → ".join(fixed(None if side[key] is None else factor * side[key], digits) for side in (old, new))
            for key, factor, digits in columns.values()
        ]
        density = ["– → –", "–"]
        if change is not None:
            half = f"{change.high - change.value:.2f}" if np.isfinite(change.low) else "?"
            density = [f"{change.first:.2f} → {change.second:.2f}", f"{change.value:+.2f} ± {half}"]
        rows.append([name, *cells, *density])
    head = ("recording", *columns, "log density, nats", "difference, 95 %")
    note = "Tracked as by `track`. Regret: nats of the log density that the scale of the covariances loses."
    title, looks = f"{about[0].upper()}{about[1:]}, before → after", dict.fromkeys(head[1:], "after")
    section = Section(title, head, rows, 1, note, looks, covariance_statements(after.overall, after.recordings))
    metrics = {old["recording"]: {key: (old[key], new[key]) for key in keys} for old, new in pairs}
    return Compared(about, section, verdict, metrics)


class TunedParameter(NamedTuple):
    """A parameter before and after; `low`, `high`: its 95 % interval, NaN where there is none.

    `determined`: whether the recordings determine it; None where the objective has no information on that.
    """

    name: str
    unit: str
    before: float
    after: float
    low: float = math.nan
    high: float = math.nan
    determined: bool | None = None


class Trace(NamedTuple):
    """The steps from one start: the objective (i,) and the physical values (i, p) of the parameters."""

    objective: np.ndarray
    values: np.ndarray


def tuned_parameters(
    result: FitResult, intervals: Mapping[str, Interval], issues: Sequence[Issue] = ()
) -> list[TunedParameter]:
    """The numbers that a fit tuned; `intervals`: 95 %, by label."""
    undetermined, made = {name for issue in issues for name in issue.names}, []
    none = {label: (np.full(np.shape(x), np.nan),) * 2 for label, x in result.values.items()} | {**intervals}
    ends = ({label: pair[k] for label, pair in none.items()} for k in (0, 1))
    before = (result.starts or [result.trace])[0][0].values
    numbers = np.stack([_flat(result, values) for values in (before, result.values, *ends)])
    finite = np.isfinite(numbers[2:]).all(axis=0)
    numbers[2:, ~finite] = np.nan
    units = [p.example.unit for p in result.parameters for _ in range(p.size)]
    for name, unit, values, ok in zip(component_names(result.parameters), units, numbers.T, finite, strict=True):
        # Without any interval it is unknown what is determined; with some, a parameter without one is undetermined.
        determined = False if name in undetermined else bool(ok) if finite.any() else None
        made.append(TunedParameter._make((name, unit, *values.tolist(), determined)))
    return made


def _flat(result: FitResult, values: Mapping[str, Any]) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(values[p.label], float)) for p in result.parameters])


def traces_of(result: FitResult) -> list[Trace]:
    """The steps of all starts, the best first."""
    ordered = sorted(result.starts or [result.trace], key=lambda steps: steps is not result.trace)
    columns = (([step.value for step in steps], [_flat(result, step.values) for step in steps]) for steps in ordered)
    return [Trace(np.array(objective), np.stack(values)) for objective, values in columns]


def recording_names(trajectories: Sequence[Trajectory]) -> list[str]:
    """The recordings of trajectories."""
    return list(dict.fromkeys(trajectory.folder.name for trajectory in trajectories))


def objective_words(data: FitData, objective: str) -> str:
    """The objective in words with its unit, where it is one by name."""
    name = "rmse-3d" if objective == "rmse" and data.dimensions == 3 else objective
    return OBJECTIVES.get(name, name).format("rad" if data.training[0].station else "m")


def tuning_page(
    result: FitResult, data: FitData, objective: str, compared: Compared, intervals: Mapping[str, Interval],
    issues: Sequence[Issue], *, tracker: str, cautions: Sequence[str], notes: Sequence[str],
    seconds: float, commands: Sequence[str],
) -> str:  # fmt: skip
    """The page of a fit. `cautions`: clauses of the fit on itself. `notes`: sentences on irregularities of the run."""
    about, parameters = objective_words(data, objective), tuned_parameters(result, intervals, issues)
    word, sentence, warnings = advice(parameters, compared, [issue.text for issue in issues], cautions)
    summary = Markup('<b class="{}">{}</b> {}').format("better" if word == "Better." else "worse", word, sentence)
    training, held_out = recording_names(data.training), recording_names(data.held_out)
    settings = {
        "Tracker": f"{tracker}: {spec_of(tracker).about}",
        "Objective": f"{about}, {number(result.start_value)} → {number(result.value)}",
        "Tuned on": listed(training, 12),
        "Held out": listed(held_out, 12) or "none",
        "Effort": f"{result.filter_runs:,} filter runs in {duration(seconds)}".replace(",", "\u202f"),
    }
    sections = [
        Section("Settings", parts=[settings, *notes]),
        parameters_section(parameters),
        compared.section,
        Section("Optimisation", parts=[[objective_chart(traces_of(result), about)]]),
    ]
    title = f"{tracker}, tuned on {counted(len(training), 'recording')}"
    foot = f"trackwright {version('trackwright')} · created {datetime.now(UTC):%Y-%m-%d %H:%M UTC}"
    return report_page("tuning report", title, [summary], sections, commands, foot, warnings)


def parameters_section(parameters: Sequence[TunedParameter]) -> Section:
    """The table of the tuned parameters."""
    lead = "No intervals: they require a likelihood or at least twenty trajectories, and a fit that converged."
    if any(p.determined is not None for p in parameters):
        lead = "Recordings say little on a parameter that is not determined, or whose interval spans a factor of ten."
    rows = []
    for p in parameters:
        interval = f"{number(p.low)} … {number(p.high)}" if math.isfinite(p.low) else MISSING
        determined, unit = MISSING if p.determined is None else yes_no(p.determined), "" if p.unit == "1" else p.unit
        rows.append([p.name, number(p.before), number(p.after), unit, interval, determined])
    head = ["parameter", "before", "after", "unit", "95 % interval", "determined?"]
    return Section("Tuned parameters", head, rows, 1, lead, {"after": "after", "determined?": "answer"})


def advice(
    parameters: Sequence[TunedParameter], compared: Compared, issues: Sequence[str], cautions: Sequence[str]
) -> tuple[str, str, list[str]]:
    """The verdict in a word, the sentence on what it is by, and warnings with advice."""
    issues = [f"{text}." for text in issues]
    if (names := [p.name for p in parameters if p.determined is False]) and not issues:
        issues = [f"The recordings do not determine {', '.join(names)}: other values fit equally well."]
    if issues:
        issues[-1] += " Do not use such values as measurements: freeze or tie these parameters, or record more motion."
    # A clause that begins with the name of a parameter keeps its case.
    said = [f"{text if '.' in text.split(' ', 1)[0] else text[0].upper() + text[1:]}." for text in cautions]
    verdict = compared.verdict
    return f"{verdict.word.capitalize()}.", verdict.sentence(compared.about), [*verdict.got_worse, *said, *issues]


def objective_chart(traces: Sequence[Trace], title: str) -> Chart:
    """The objective at every step of every start, the best first, and the point selected: the last."""
    # A start with a far larger objective must not flatten all others.
    least, top = min(float(np.nanmin(t.objective)) for t in traces), float(np.nanmax(traces[0].objective))
    margin = 0.06 * (top - least) or 0.1 * abs(least) or 1.0
    last = int(np.flatnonzero(np.isfinite(traces[0].objective))[-1])
    words, parts = {0: "best start", 1: "other starts"} if len(traces) > 1 else {}, []
    for k, trace in reversed([*enumerate(traces)]):
        colour, width = (PALE, 1.1) if k else (BLUE, 1.8)
        parts.append(Line(np.arange(len(trace.objective)), trace.objective, words.get(k, ""), colour, width))
    end = float(traces[0].objective[last])
    parts.append(Line([last], [end], f"selected: {number(end)}", width=0, marker="circle"))
    name = f"Objective from {counted(len(traces), 'start')}"
    return Chart("tuning", name, "step", title, parts, ylim=(least - margin, top + margin))


def sweep_chart(swept: Sweep, objective: str) -> Chart:
    """The objective over the first number of a grid, a curve for each value of the second, and its least value.

    `objective`: its name and unit. Of one number the band is the standard deviation over repeats.
    """
    mean, at, grid = swept.mean, swept.best_index, swept.grids[0]
    words = [
        f"{p.label} = {of[k]:.4g}{'' if p.example.unit in ('', '1') else f' {p.example.unit}'}"
        for p, of, k in zip(swept.parameters, swept.grids, at, strict=True)
    ]
    parts = []
    if mean.ndim == 1 and len(swept.values) > 1:
        ends = mean - swept.spread, mean + swept.spread
        parts.append(band(grid, *ends, "± standard deviation over repeats"))
    for k, values in enumerate(mean.reshape(len(grid), -1).T):
        name = f"{swept.parameters[1].label} {swept.grids[1][k]:.4g}" if mean.ndim > 1 else ""
        parts.append(Line(grid, values, name, LINES[k % len(LINES)], marker="circle", size=3.5))
    parts.append(Line([grid[at[0]]], [mean[at]], "minimum", VERMILION, 0.0, marker="circle", size=8))
    unit, title = swept.parameters[0].example.unit, f"{objective}: minimum {mean[at]:.5g} at {', '.join(words)}"
    label = swept.parameters[0].label + ("" if unit in ("", "1") else f" ({unit})")
    return Chart("sweep", title, label, objective, parts, log="x" * is_logarithmic(grid), height=3.6)


def sweep_plot(path: Path, swept: Sweep, objective: str) -> Path:
    """Writes the chart of a sweep; returns the path. Raises UnusableInput where the file can't be written."""
    return write(sweep_chart(swept, objective), path)
