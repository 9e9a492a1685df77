"""Error metrics of estimates against truth, by track, by recording and overall, and sentences on covariances.

A metric without data (no heights, no reported covariance) is None.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from trackwright.trackers.core.data.frames import html_table, text_lines
from trackwright.trackers.core.errors import (
    UnusableInput,
    counted,
    listed,
    near,
    numbered_names,
    one_or_more,
    require,
    significant,
)
from trackwright.trackers.evaluation.metrics import added, metrics, sums
from trackwright.trackers.evaluation.rows import refuse_without_overlap, scored_rows
from trackwright.trackers.recordings.folder import RecordingFolder, refuse_same_names
from trackwright.trackers.recordings.tracks_table import is_bearing, track_keys

# Tables are evaluated without jax, which takes as long to import as most of them to evaluate.
if TYPE_CHECKING:
    from trackwright.trackers.core.data.estimates import Estimates
    from trackwright.trackers.core.data.recording import Recording
    from trackwright.trackers.recordings.tracks import Tracks

    OneOrMore = RecordingFolder | Recording | Iterable[RecordingFolder | Recording]

Metrics = dict[str, Any]  # by name; in lists by recording and by track also `recording`, `tag` and `station`

# Fewest effective samples for a verdict; largest share of rows that may be lost, or without a covariance, for one;
# share of the RMSE, without biases, below which what is left without a lag is told.
LEAST_SAMPLES, LOST, LATE = 8.0, 0.1, 0.8
MOST_ROWS = 12  # rows of the table of an evaluation that a terminal shows

HOLD, SHORT, SMALL, LARGE = "hold", "too short", "too small", "too large"


@dataclass(frozen=True, repr=False)
class Evaluation:
    """Error metrics over all rows, by recording and by track; `bearing`: of bearings, not of positions.

    `metrics["rmse_m"]` is a metric over all rows; names as in docs/formats.md.
    """

    bearing: bool
    overall: Metrics
    recordings: Sequence[Metrics]
    tracks: Sequence[Metrics]

    @classmethod
    def of(cls, rows: pl.DataFrame) -> Evaluation:
        """The metrics of scored rows; None if no row is scored."""
        recordings, tracks = sums(rows, "recording"), sums(rows, *track_keys(rows))
        levels = [of.select(pl.col(pl.String)).hstack(metrics(of)).to_dicts() for of in (recordings, tracks)]
        return cls(is_bearing(rows), metrics(added(recordings, rows.lazy())).row(0, named=True), *levels)

    def __getitem__(self, metric: str) -> Any:
        return self.overall[metric]

    @property
    def statements(self) -> list[str]:
        """Sentences on whether the reported covariances hold; without truth, on what the innovations show."""
        return covariance_statements(self.overall, self.recordings)

    def to_polars(self) -> pl.DataFrame:
        """A table with one row per track and one column per metric."""
        return pl.DataFrame(self.tracks, infer_schema_length=None)

    def _repr_html_(self) -> str:
        return html_table(" ".join(self.statements), *self._main_metrics())

    def __repr__(self) -> str:
        head, rows = self._main_metrics()
        cells = [[f"{x:.4g}" if isinstance(x, float) else str(x) for x in row] for row in rows[:MOST_ROWS]]
        lines = text_lines([list(head), *cells], "<<" + ">" * (len(head) - 2))
        more = [f"… {len(rows) - MOST_ROWS} more"] if len(rows) > MOST_ROWS else []
        return "\n".join([*lines, *more, *self.statements])

    def _main_metrics(self) -> tuple[tuple[str, ...], list[tuple[Any, ...]]]:
        """The names of the columns, and the rows: overall, of each recording and of each track."""
        first = "rmse_direction_rad" if self.bearing else "rmse_m"
        shown = ("n", first, first.replace("rmse", "p95"), first.replace("rmse", "max"), "coverage_95", "nees_ratio")
        lines = [(("overall", ""), self.overall)]
        lines += [((m["recording"], "all"), m) for m in self.recordings]
        lines += [((m["recording"], m["tag"]), m) for m in self.tracks]
        return ("recording", "tag", *shown), [(*names, *(metrics[name] for name in shown)) for names, metrics in lines]


def evaluate(estimates: Tracks | Estimates | pl.DataFrame, recordings: OneOrMore) -> Evaluation:
    """The error metrics of estimates against the truth of their recordings, interpolated at the times of the estimates.

    `estimates`: `Tracks`, a table with the columns of tracks.parquet, or the `Estimates` of `Recording`s whose truth is
    a `position`. Recordings in arrays of one name are told apart by their place, which must be the run's. Raises
    UnusableInput if no recording has a truth, or no estimate lies inside the truth of its recording and tag, and for
    two folders of one name.
    """
    several = _several(recordings)
    refuse_without_overlap(rows := rows_of(estimates, several), truths_of(several))
    return Evaluation.of(rows)


def rows_of(estimates: Tracks | Estimates | pl.DataFrame, recordings: OneOrMore) -> pl.DataFrame:
    """The `scored_rows` of estimates; arguments as of `evaluate`. Raises UnusableInput if no recording has a truth."""
    several = _several(recordings)
    table = estimates.to_polars() if hasattr(estimates, "to_polars") else estimates
    require(isinstance(table, pl.DataFrame), "evaluate", estimates, "estimates, or their table `to_polars()`")
    if "tag" not in table.columns and not any(isinstance(recording, RecordingFolder) for recording in several):
        names = [*getattr(estimates, "names", ())]
        if len({*names}) < len(names) and names != [recording.name for recording in several]:
            found = f"recordings of the run share a name ({', '.join(names)}) and have only their places"
            fix = "expected the same in the same order; or give each a `name` where it is made"
            raise UnusableInput(f"evaluate: {found}; {fix}")
        table = table.with_columns(tag=pl.lit(""))
    if not truths_of(several):
        names = [str(getattr(recording, "path", None) or recording.name) for recording in several]
        raise UnusableInput(f"{', '.join(names)}: no truth table, nor truth of a `position`; give recordings with it")
    return with_truth(table, several)


def with_truth(tracks: pl.DataFrame, recordings: OneOrMore) -> pl.DataFrame:
    """The `scored_rows` of a table of tracks; none of them is scored without a truth."""
    several = _several(recordings)
    stations = {folder.name: folder.rig.stations for folder in several if isinstance(folder, RecordingFolder)}
    return scored_rows(tracks, truths_of(several), stations)


def _several(recordings: OneOrMore) -> list[RecordingFolder | Recording]:
    # Of recording folders alone jax need not be imported.
    kinds: tuple[type[RecordingFolder | Recording], ...] = (RecordingFolder,)
    if not (isinstance(recordings, Sequence) and all(isinstance(r, RecordingFolder) for r in recordings)):
        from trackwright.trackers.core.data.recording import Recording

        kinds = (RecordingFolder, Recording)
    return one_or_more(recordings, kinds, "recordings as the second argument, evaluate(estimates, recordings)")


def truths_of(recordings: OneOrMore) -> dict[str, pl.DataFrame]:
    """The truth tables of the recordings that have one, by name; raises UnusableInput for two folders of one name."""
    several = _several(recordings)
    refuse_same_names([recording.name for recording in several if isinstance(recording, RecordingFolder)])
    truths = {}
    for name, recording in zip(numbered_names([recording.name for recording in several]), several, strict=True):
        if isinstance(recording, RecordingFolder):
            if "truth" in recording.tables:
                truths[name] = recording.tables["truth"]
        elif "position" in recording.truth:
            values, known = recording.truth["position"]
            axes = {f"{a}_m": x for a, x in zip("xyz", np.asarray(values, float)[known].T, strict=False)}
            truths[name] = pl.DataFrame({"t_s": recording.times[known], "tag": [""] * int(known.sum()), **axes})
    return truths


def metric_names(tracks: pl.DataFrame) -> list[str]:
    """The names of the metrics that such estimates, the columns of tracks.parquet, have overall."""
    return list(Evaluation.of(scored_rows(tracks.head(1), {})).overall)


def condition_of(expression: str, names: Sequence[str]) -> pl.Expr:
    """The condition on metrics of these names; raises UnusableInput for a text that is none."""
    problem = "no condition on metrics, expected NAME OPERATOR NUMBER joined by and, or, e.g. p95_m>0.5"
    try:
        condition = pl.sql_expr(f"({expression})")  # else 50cm is 50, called cm
        used = condition.meta.root_names()
        if unknown := [name for name in used if name not in names]:
            problem = f"no metric '{unknown[0]}'{near(unknown[0], names)}"
        elif used and pl.DataFrame({name: [0.0] for name in used}).select(condition).dtypes == [pl.Boolean]:
            return condition
    except pl.exceptions.PolarsError:
        pass
    raise UnusableInput(f"--fail-if '{expression}': {problem}; names: {', '.join(names)}")


def violation(evaluation: Evaluation, expression: str) -> str | None:
    """The condition and its metrics, None where it is false; raises UnusableInput for a metric without a value, too."""
    overall = evaluation.overall
    condition = condition_of(expression, [*overall])
    values = {name: overall[name] for name in condition.meta.root_names()}
    if lacking := [name for name, value in values.items() if value is None]:
        raise UnusableInput(f"--fail-if '{expression}': '{lacking[0]}' has no value for these tracks; name another")
    words = f"{expression} ({', '.join(f'{name} is {value:.6g}' for name, value in values.items())})"
    return words if pl.DataFrame([values]).select(condition).item() else None


def verdict(metrics: Mapping[str, Any], name: str = "nees") -> str | None:
    """Whether `nees`, `nees_3d` or `nis` is in its band, whether the recording is too short for that, or what is wrong.

    None where it is unknown: without covariances, or where more than `LOST` of the rows have none.
    """
    ratio, end = metrics.get(f"{name}_ratio"), name.removeprefix("nees")
    if ratio is None or (name != "nis" and max(_unknown(metrics, x) for x in ("", end)) > LOST):
        return None
    if metrics[f"n_effective_{name}".replace("_nees", "")] < LEAST_SAMPLES:
        return SHORT
    return SMALL if ratio > metrics[f"{name}_high"] else LARGE if ratio < metrics[f"{name}_low"] else HOLD


def covariance_statements(overall: Mapping[str, Any], recordings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Sentences on the metrics of all rows, and on the recordings whose covariances do not hold; losses come first.

    Nothing on covariances where tracks are lost in more than `LOST` of the rows; without any, on the innovations.
    """
    sentences, losses = list[str](), overall["losses"]
    if losses:
        lost = f"Tracks were lost {counted(losses, 'time')}, for {overall['lost_s']:.3g} s in all."
        sentences.append(f"{lost} With a suitable model a track is lost only where readings are missing.")
    if losses and max(losses / overall["n_rows"], overall["lost_fraction"]) > LOST:
        return sentences
    rmse, without, lag = (overall.get(name) or 0.0 for name in ("rmse_m", "rmse_without_lag_m", "lag_s"))
    # On a way in one direction a bias looks like a lag.
    if lag and without < LATE * math.sqrt(max(rmse**2 - overall["bias_x_m"] ** 2 - overall["bias_y_m"] ** 2, 0.0)):
        late = f"Estimates are {abs(lag):.2g} s {'late' if lag > 0 else 'early'} along the true path"
        why = "the fixes or the filter lag, or the clock of the truth is another"
        sentences.append(f"{late}, without which RMSE is {without:.2g} m, not {rmse:.2g}: {why}.")
    if overall["coverage_95"] is None:
        return sentences + _sentence(overall, "nis")
    sentences += _sentence(overall, "nees")
    wrong = [f"{r['recording']} ({_factor(r, 'nees')} {v})" for r in recordings if (v := verdict(r)) in (SMALL, LARGE)]
    if wrong and len(recordings) > 1:
        sentences.append(f"Outside their band: {len(wrong)} of {len(recordings)} recordings, {listed(wrong)}.")
    if verdict(overall, "nees_3d") in (SMALL, LARGE):
        sentences += _sentence(overall, "nees_3d")
    end = "" if _unknown(overall, "") else "_3d"
    if unknown := _unknown(overall, end):
        none, zero = (overall[f"n_{what}_covariance{end}"] for what in ("no", "zero"))
        rows = f"{none} of {overall['n']} rows are without a covariance{' in three dimensions' if end else ''}"
        judged = "; with more than a tenth, covariances are not judged" if unknown > LOST else ""
        sentences.append(f"{rows}, {zero} of them with a zero or singular one, which has no truth inside{judged}.")
    return sentences


def _unknown(metrics: Mapping[str, Any], end: str) -> float:
    """The share of rows without a covariance, or with one of zero."""
    return (metrics.get(f"n_no_covariance{end}") or 0) / (metrics.get("n") or 1)


def _factor(metrics: Mapping[str, Any], name: str) -> str:
    """How many times standard deviations are too small or too large, the root of NEES or NIS per degree of freedom."""
    root = math.sqrt(metrics[f"{name}_ratio"])
    times = max(root, 1 / root) if root else math.inf  # errors of a copy are zero
    return f"{significant(times, 2 if times >= 1.1 else 4)} times"


def _sentence(metrics: Mapping[str, Any], name: str) -> list[str]:
    """The verdict on NEES or NIS with its band, its effective samples and the regret; none without a verdict."""
    found = verdict(metrics, name)
    if found is None:
        return []
    what = "Standard deviations of the innovations" if name == "nis" else "Reported standard deviations"
    what += " in three dimensions" * (name == "nees_3d")
    words = {HOLD: "as those of a perfect filter", SHORT: f"not judged, the recording is {SHORT}"}
    ratio, low, high = (significant(metrics[f"{name}_{x}"], 3) for x in ("ratio", "low", "high"))
    lost = metrics.get(f"regret{name.removeprefix('nees')}")
    samples = significant(metrics[f"n_effective_{name}".replace("_nees", "")], 3)
    figures = f"band {low} to {high} ({samples} effective samples)"
    figures += "" if lost is None else f", regret {significant(lost, 2)} nats"
    judged = words.get(found) or f"{_factor(metrics, name)} {found}"
    return [f"{what} are {judged}: {name[:4].strip('_').upper()}/dof {ratio}, {figures}."]
