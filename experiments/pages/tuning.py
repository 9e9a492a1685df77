"""A fit as tables, curves and one page: its verdict, what it changed, and what the recordings do not determine."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from markupsafe import Markup

from trackwright.experiments.pages.chart import BLUE, LINES, PALE, VERMILION, Chart, Line, band, is_logarithmic
from trackwright.experiments.pages.comparison import comparison
from trackwright.experiments.pages.report import report_page
from trackwright.experiments.text.tables import MISSING, Section, number, sections_text, yes_no
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.errors import counted, listed
from trackwright.trackers.evaluation.comparison import Difference, paired_means
from trackwright.trackers.evaluation.evaluate import Evaluation, covariance_statements, with_truth
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.tuning.data import FitData
from trackwright.tuning.fit_warnings import Issue
from trackwright.tuning.fitting import FitResult, left_out_blocks, left_out_values
from trackwright.tuning.parameters import component_names
from trackwright.tuning.sweeping import Sweep
from trackwright.tuning.uncertainty import Interval


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
        worse = {name: d for name, d in self.recordings.items() if d.high < 0}
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
    """Recordings, in words `about`, before and after tuning: tables, sentences on the covariances after it, verdict."""

    about: str
    sections: Sequence[Section]
    statements: Sequence[str]
    verdict: Verdict
    metrics: Mapping[str, Mapping[str, tuple[float | None, float | None]]] = {}

    def text(self) -> str:
        """The tables, the sentences and the verdict for a terminal."""
        verdict = f"Verdict: {self.verdict.word}. {self.verdict.sentence(self.about)}"
        return sections_text(self.sections, 120, *self.statements, verdict, *self.verdict.got_worse)

    def content(self) -> dict[str, Any]:
        """The verdict and the main metrics as tuned.toml holds them, nan for what is unknown."""
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


def left_out_estimates(
    result: FitResult, data: FitData, named: NamedTracker, folders: Sequence[RecordingFolder], before: pl.DataFrame
) -> tuple[pl.DataFrame, str]:
    """The estimates of recordings with values fitted without them, and how, in words; empty where the fit has seen
    their truth, whose estimates have the fitted values.

    `before`: their estimates before the fit, by whose rows blocks of time are cut: a fitted latency moves times.
    """

    def table(values: Mapping[str, np.ndarray]) -> pl.DataFrame:
        by_name = {name: values[p.label] for p in result.parameters for name in p.names}
        return named.with_values(by_name, "the fit").run(folders).table

    parts, words = list[tuple[Mapping[str, np.ndarray], pl.Expr]](), ", whose truth the fit has not seen"
    if data.held_out:
        pass
    # All are tracked with the values of each fold, by the one program that is compiled for them.
    elif left_out := left_out_values(result):
        words = ", each with values fitted to the others"
        values_of = {folder.name: left_out.get(folder.name, result.values) for folder in folders}
        for values in {id(values): values for values in values_of.values()}.values():
            names = [name for name, other in values_of.items() if other is values]
            parts.append((values, pl.col("recording").is_in(names)))
    elif blocks := left_out_blocks(result, data):
        words = f", each of {len(blocks)} blocks of time with values fitted without its truth"
        starts = [-np.inf, *(start for start, _, _ in blocks[1:]), np.inf]
        for (start, stop), (_, _, values) in zip(pairwise(starts), blocks, strict=True):
            parts.append((values, pl.col("t_s").is_between(start, stop, "left")))
    elif data.objective.needs_truth:
        words = ""
    if not parts:
        return table(result.values), words
    tables = [table(values).with_row_index("row").filter(before.select(own).to_series()) for values, own in parts]
    return pl.concat(tables).sort("row").drop("row"), words


def compare_left_out(
    result: FitResult, data: FitData, named: NamedTracker, training: Sequence[RecordingFolder],
    held_out: Sequence[RecordingFolder],
) -> Compared:  # fmt: skip
    """The held-out recordings before and after the fit, or those of the training, each with values fitted without it.

    There is no verdict where the fit was interrupted, or can leave nothing out.
    """
    shown = held_out or training
    before = tracked(named, shown)
    table, judged_by = left_out_estimates(result, data, named, shown, before)
    about = "held-out recordings" if held_out else f"recording{'s' * (len(training) > 1)} tuned on{judged_by}"
    why_not = "" if judged_by else "the fit cannot leave a recording or a block of time out"
    why_not = "the fit was interrupted" if result.uncertainty is None else why_not
    return compare((before, with_truth(table, shown)), shown, data.dimensions, about, why_not)


def compare(
    sides: Sequence[pl.DataFrame], folders: Sequence[RecordingFolder], dimensions: int, about: str, why_not: str = ""
) -> Compared:
    """The recordings `folders` in the estimates before and after tuning, those of `tracked`, compared as two runs.

    `dimensions`: 3 for errors and ellipsoids in space. `about`: in words, the recordings. `why_not`: why there is no
    verdict. A recording without truth has no figures but those of its innovations.
    """
    sides = [side.filter(pl.col("recording").is_in([folder.name for folder in folders])) for side in sides]
    before, after = (Evaluation.of(side) for side in sides)
    suffix = "_3d" if dimensions == 3 and before.overall.get("coverage_95_3d") is not None else ""
    verdict = Verdict(None, {}, why_not) if why_not else judge(sides, 3 if suffix else 2)
    error = "rmse_direction_rad" if before.bearing else f"rmse{suffix}_m"
    keys = [error, f"coverage_95{suffix}", f"nees{suffix}_ratio", f"regret{suffix}", "nis_ratio"]
    pairs = zip(before.recordings, after.recordings, strict=True)
    metrics = {old["recording"]: {key: (old[key], new[key]) for key in keys} for old, new in pairs}
    first, *differences = comparison(dict(zip(("before", "after"), sides, strict=True)))[0]
    title = f"{about[0].upper()}{about[1:]}: {first.title[0].lower()}{first.title[1:]}"
    statements = covariance_statements(after.overall, after.recordings)
    return Compared(about, [first._replace(title=title), *differences], statements, verdict, metrics)


class TunedParameter(NamedTuple):
    """A parameter before and after, its 95 % interval, NaN if unknown, whether it is determined, None if unknown."""

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
    undetermined, none = {name for issue in issues for name in issue.names}, (np.nan, np.nan)
    ends = ({p.label: np.broadcast_to(intervals.get(p.label, none)[k], np.shape(result.values[p.label]))
             for p in result.parameters} for k in (0, 1))  # fmt: skip
    before = (result.starts or [result.trace])[0][0].values
    columns = np.stack([_flat(result, values) for values in (before, result.values, *ends)], axis=1)
    finite = np.isfinite(columns).all(axis=1)
    columns[~finite, 2:] = np.nan
    units = [p.example.unit for p in result.parameters for _ in range(p.size)]
    # Without any interval it is unknown what is determined; with some, a parameter without one is undetermined.
    return [
        TunedParameter._make((name, unit, *values, False if name in undetermined else known if finite.any() else None))
        for name, unit, values, known in zip(
            component_names(result.parameters), units, columns.tolist(), finite.tolist(), strict=True
        )
    ]


def _flat(result: FitResult, values: Mapping[str, Any]) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(values[p.label], float)) for p in result.parameters])


def traces_of(result: FitResult) -> list[Trace]:
    """The steps of all starts, the best first."""
    ordered = sorted(result.starts or [result.trace], key=lambda steps: steps is not result.trace)
    columns = (([step.value for step in steps], [_flat(result, step.values) for step in steps]) for steps in ordered)
    return [Trace(np.array(objective), np.stack(values)) for objective, values in columns]


def tuning_page(
    result: FitResult, data: FitData, objective: str, compared: Compared, intervals: Mapping[str, Interval],
    issues: Sequence[Issue], *, tracker: str, cautions: Sequence[str], commands: Sequence[str],
) -> str:  # fmt: skip
    """The page of a fit. `cautions`: clauses of the fit on itself."""
    parameters = tuned_parameters(result, intervals, issues)
    word, sentence, warnings = advice(parameters, compared, [issue.text for issue in issues], cautions)
    summary = Markup('<b class="{}">{}</b> {}').format("better" if word == "Better." else "worse", word, sentence)
    training, held_out = (dict.fromkeys(t.folder.name for t in part) for part in (data.training, data.held_out))
    notes = [f"{result.n_excluded} of {len(data.training)} segments were excluded."] * bool(result.n_excluded)
    notes += ["The held-out recordings were used to select the best point and to stop the fit."] * bool(held_out)
    settings = {
        "Tracker": f"{tracker}: {spec_of(tracker).about}",
        "Objective": f"{objective}, {number(result.start_value)} → {number(result.value)}",
        "Tuned on": listed(training, 12),
        "Held out": listed(held_out, 12) or "none",
    }
    sections = [
        Section("Settings", parts=[settings, *notes]),
        parameters_section(parameters),
        *compared.sections,
        Section("Covariances after the fit", parts=compared.statements),
        Section("Optimisation", parts=[[objective_chart(traces_of(result), objective)]]),
    ]
    title = f"{tracker}, tuned on {counted(len(training), 'recording')}"
    return report_page("tuning report", title, [summary], sections, commands, warnings)


def parameters_section(parameters: Sequence[TunedParameter]) -> Section:
    """The table of the tuned parameters."""
    lead = "No intervals: they require a likelihood or at least twenty trajectories, and a fit that converged."
    if any(p.determined is not None for p in parameters):
        lead = "Recordings say little on a parameter that is not determined, or whose interval spans a factor of ten."
    rows = [
        [p.name, number(p.before), number(p.after), "" if p.unit == "1" else p.unit,
         f"{number(p.low)} … {number(p.high)}" if math.isfinite(p.low) else MISSING, yes_no(p.determined) or MISSING]
        for p in parameters
    ]  # fmt: skip
    head = ["parameter", "before", "after", "unit", "95 % interval", "determined?"]
    return Section("Tuned parameters", head, rows, 1, lead)


def advice(
    parameters: Sequence[TunedParameter], compared: Compared, issues: Sequence[str], cautions: Sequence[str]
) -> tuple[str, str, list[str]]:
    """The verdict in a word, the sentence on what it is by, and warnings with advice."""
    names, verdict = [p.name for p in parameters if p.determined is False], compared.verdict
    # A clause that begins with the name of a parameter keeps its case.
    said = [f"{x if '.' in x.split(' ')[0] else x[:1].upper() + x[1:]}." for x in (*cautions, *issues)]
    if names:
        said.append(
            f"Not determined by the recordings: {', '.join(names)}. Do not use such values as measurements: freeze or "
            "tie these parameters, or record more motion."
        )
    return f"{verdict.word.capitalize()}.", verdict.sentence(compared.about), [*verdict.got_worse, *said]


def objective_chart(traces: Sequence[Trace], title: str) -> Chart:
    """The objective at every step of every start, the best first, and the point selected: the last."""
    # A start with a far larger objective must not flatten all others.
    least, top = min(float(np.nanmin(t.objective)) for t in traces), float(np.nanmax(traces[0].objective))
    margin = 0.06 * (top - least) or 0.1 * abs(least) or 1.0
    last = int(np.flatnonzero(np.isfinite(traces[0].objective))[-1])
    words, parts = {0: "best start", 1: "other starts"} if len(traces) > 1 else dict[int, str](), []
    for k, trace in reversed([*enumerate(traces)]):
        colour, width = (PALE, 1.1) if k else (BLUE, 1.8)
        parts.append(Line(np.arange(len(trace.objective)), trace.objective, words.get(k, ""), colour, width))
    end = float(traces[0].objective[last])
    parts.append(Line([last], [end], f"selected: {number(end)}", width=0, marker="circle"))
    name = f"Objective from {counted(len(traces), 'start')}"
    return Chart("tuning", name, "step", title, parts, ylim=(least - margin, top + margin))


def sweep_chart(swept: Sweep, objective: str) -> Chart:
    """The objective over the first number of a grid, a curve for each value of the second, and its least value."""
    mean, at, grid, (first, *second) = swept.mean, swept.best_index, swept.grids[0], swept.parameters
    parts = []
    if not second and len(swept.values) > 1:
        parts.append(band(grid, mean - swept.spread, mean + swept.spread, "± standard deviation over repeats"))
    for k, values in enumerate(mean.reshape(len(grid), -1).T):
        name = f"{second[0].label} {swept.grids[1][k]:.4g}" if second else ""
        parts.append(Line(grid, values, name, LINES[k % len(LINES)], marker="circle", size=3.5))
    parts.append(Line([grid[at[0]]], [mean[at]], "minimum", VERMILION, 0.0, marker="circle", size=8))
    where = ", ".join(f"{name} = {value:.4g}" for name, value in swept.best.items())
    label = first.label + ("" if first.example.unit in ("", "1") else f" ({first.example.unit})")
    title = f"{objective}: minimum {mean[at]:.5g} at {where}"
    return Chart("sweep", title, label, objective, parts, log="x" * is_logarithmic(grid), height=3.6)
