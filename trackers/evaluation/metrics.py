"""The table of metrics. A metric is one entry: its words and an expression over sums of scored rows.

Sums add up over tracks, recordings and the trajectories of a study, which takes its metrics from here as well. Names
are as in `--fail-if`, evaluation.json and studies, in metres and radians, horizontal unless they have `3d`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import NamedTuple, TypeVar

import polars as pl
from polars import selectors as cs

from trackwright.trackers.core.data.consistency import NORMAL, chi_square_quantile
from trackwright.trackers.evaluation.rows import WHY


class Metric(NamedTuple):
    """A metric: its name, what it is in words, its unit, and its expression over the sums of groups of rows.

    `unit`: m, m², rad, s, rows, nats, % of a share, or none. `short`: the heading of its column in tables; without one,
    files alone have it. `rank`: of a table too wide for the terminal, the highest are left out first. `page`: whether
    the page of `track` has it. `right`: its value for right covariances.
    """

    name: str
    words: str
    unit: str
    expr: pl.Expr
    short: str = ""
    rank: int = 0
    page: bool = False
    right: float | None = None


COLUMNS = {
    "n": ("n", 0, True), "rmse_m": ("RMSE", 0, True), "median_m": ("median", 2, True), "p95_m": ("p95", 0, True),
    "max_m": ("max", 0, True), "rmse_3d_m": ("3-D\nRMSE", 0, True), "rmse_heading_rad": ("heading,\n° RMSE", 0, True),
    "rmse_azimuth_rad": ("az\nRMSE", 0, True), "rmse_elevation_rad": ("el\nRMSE", 0, True),
    "rmse_direction_rad": ("angle\nRMSE", 1, True), "median_direction_rad": ("angle\nmedian", 2, False),
    "p95_direction_rad": ("angle\np95", 0, True), "coverage_95": ("% in\n95 %", 0, True),
    "nees_ratio": ("NEES\n/dof", 0, True), "regret": ("regret", 0, True), "log_density": ("log\ndensity", 1, True),
    "energy_score_m": ("energy\nscore", 2, True), "nis_ratio": ("NIS\n/dof", 2, True), "lost_s": ("lost", 0, True),
}  # fmt: skip
"""The metrics with a column in tables: `short`, `rank` and `page` of `Metric`."""

ERROR_KINDS = {"m": "", "3d_m": "in 3-D", "heading_rad": "of heading", "azimuth_rad": "of azimuth",
               "elevation_rad": "of elevation", "direction_rad": "of direction"}  # fmt: skip
"""The kinds of errors by the suffix of the names of their metrics, with the words after a statistic's."""

SHARES = {"median": 0.5, "p90": 0.9, "p95": 0.95, "p99": 0.99}  # the quantiles of errors that are metrics
LEVELS = (50, 68, 90, 95, 99)  # levels, %, of the ellipses whose share of the truth is a metric
# The kind of errors whose rows count for the bias of a component.
BIASES = {"x_m": "m", "y_m": "m", "z_m": "3d_m", "azimuth_rad": "azimuth_rad", "elevation_rad": "elevation_rad"}

UNCERTAIN = 3.0  # the band belongs to n²/(n + 3) samples: n itself is estimated, which matters below some 20 samples
C, MEASURED = pl.col, pl.col("nis").is_finite() & (pl.col("nis_dof") > 0)


def _nees_terms(name: str, dof: int) -> dict[str, pl.Expr]:
    """The terms of NEES: `nees`, or `nees_3d`, which a known height does not have in any row of its track."""
    nees, space = C(name), name.removeprefix("nees")
    finite, scored = nees.is_finite().fill_null(False), C("why").is_null()
    judged = (C("size_3d_m").is_not_null() & nees.is_not_null().any().over("track")) if space else scored
    return {
        f"n {name}": finite,
        f"sum {name}": pl.when(finite).then(nees),
        **{f"inside {p} {name}": nees <= chi_square_quantile(p / 100, dof) for p in LEVELS},
        f"zero {name}": scored & nees.is_infinite(),
        f"judged {name}": nees.is_not_null(),
        f"no {name}": scored & judged & ~finite,
        f"slow {name}": C(f"slow{space}"),
        f"log density {name}": C(f"density{space}"),
        f"energy {name}": C(f"energy{space}"),
    }


TERMS = {
    "n": C("why").is_null(),
    "n_rows": C("track").is_not_null(),
    **{f"n_{reason.replace(' ', '_')}": (C("why") == reason).fill_null(False) for reason in WHY.values()},
    **{f"n {kind}": C(f"size_{kind}").is_not_null() for kind in ERROR_KINDS},
    **{f"sum {kind}": C(f"size_{kind}") for kind in ERROR_KINDS},
    **{f"squares {kind}": C(f"size_{kind}") ** 2 for kind in ERROR_KINDS},
    **{f"bias {x}": pl.when(C(f"size_{kind}").is_not_null()).then(C(f"error_{x}")) for x, kind in BIASES.items()},
    **_nees_terms("nees", 2),
    **_nees_terms("nees_3d", 3),
    "nis": pl.when(MEASURED).then(C("nis")),
    "dof": pl.when(MEASURED).then(C("nis_dof")),
    "n nis": MEASURED,
    "slow nis": C("slow_nis"),
    "along": C("along"),
    "way": C("way"),
    "lost s": pl.when(C("lost")).then(C("step_s")),
    "span s": C("step_s"),
    "lost rows": C("lost"),
    "losses": C("losses"),
}
"""What is summed over rows, by name."""

# Largest values of groups of rows, by name.
LARGEST = {f"largest {kind}": C(f"size_{kind}").max() for kind in ERROR_KINDS}
# Quantiles of groups of rows, by share and kind of error.
QUANTILES = {f"{p} {kind}": C(f"size_{kind}").quantile(p, "linear") for kind in ERROR_KINDS for p in SHARES.values()}

Frame = TypeVar("Frame", pl.DataFrame, pl.LazyFrame)


def sums(rows: Frame, *by: str) -> Frame:
    """The `TERMS` of these rows summed by the columns `by`, or over all of them, with largest values and quantiles."""
    terms = _known(TERMS, rows)
    whole = {name: C(f"term {name}").sum() for name in terms} | _known(LARGEST | QUANTILES, rows)
    flat = rows.with_columns(**{f"term {name}": x for name, x in terms.items()})
    return flat.group_by(by, maintain_order=True).agg(**whole) if by else flat.select(**whole)


def added(parts: pl.DataFrame, rows: pl.LazyFrame) -> pl.DataFrame:
    """The sums of all from sums of parts (g,), and the quantiles of all their `rows`."""
    known = [name for name in QUANTILES if name in parts.columns]
    whole = parts.select(C(x).max() if x in LARGEST else C(x).sum() for x in parts.columns if x != "recording")
    return whole.with_columns(sums(rows).select(known).collect())


def metrics(of: Frame, names: Collection[str] = ()) -> Frame:
    """The metrics (g,) of sums (g,), of these names or all that the sums allow; null where there are no data."""
    wanted = {name: metric.expr for name, metric in METRICS.items() if not names or name in names}
    return of.select(**_known(wanted, of)).with_columns(cs.float().fill_nan(None))


def _known(expressions: Mapping[str, pl.Expr], frame: pl.DataFrame | pl.LazyFrame) -> dict[str, pl.Expr]:
    """The expressions of columns that the frame has."""
    columns = {*frame.collect_schema()}
    return {name: x for name, x in expressions.items() if columns.issuperset(x.meta.root_names())}


def _of_kind(kind: str) -> Iterator[Metric]:
    """The statistics of the sizes of errors of a kind."""
    n, total, squares = (C(f"{term} {kind}") for term in ("n", "sum", "squares"))
    statistics = {"rmse": ("RMSE", (squares / n).sqrt()), "mean": ("mean size of errors (MAE)", total / n)}
    statistics |= {name: (f"{100 * p:.0f}th percentile", C(f"{p} {kind}")) for name, p in SHARES.items()}
    statistics["median"] = "median error", statistics["median"][1]
    for name, (words, expr) in (statistics | {"max": ("largest error", C(f"largest {kind}"))}).items():
        yield Metric(f"{name}_{kind}", f"{words} {ERROR_KINDS[kind]}".strip(), kind.split("_")[-1], expr)


def _consistency(name: str, dof: int) -> Iterator[Metric]:
    """The metrics of NEES: `nees`, or `nees_3d`."""
    end, shape, space = ("_3d", "ellipsoid", " in 3-D") if dof == 3 else ("", "ellipse", "")
    n, ratio = C(f"n {name}"), C(f"sum {name}") / C(f"n {name}") / dof
    for what, words in (("no", "rows without a covariance"), ("zero", "rows with a zero or singular covariance")):
        yield Metric(f"n_{what}_covariance{end}", words + space, "rows", C(f"{what} {name}"))
    for p in LEVELS:
        inside = C(f"inside {p} {name}") / C(f"judged {name}")
        yield Metric(f"coverage_{p}{end}", f"inside the {p} % {shape}", "%", inside, right=p / 100)
    yield Metric(f"{name}_mean", f"NEES{space}, {dof} expected", "", C(f"sum {name}") / n, right=float(dof))
    yield Metric(f"{name}_ratio", f"NEES per degree of freedom{space}, 1 expected", "", ratio, right=1.0)
    lost = f"log density lost by the scale of the covariances{space}"
    yield Metric(f"regret{end}", lost, "nats", pl.when(ratio > 0).then(ratio - 1 - ratio.log()))
    yield from _band(name, end, space, dof)
    density = C(f"log density {name}") / n
    yield Metric(f"log_density{end}", f"mean log density of the true position{space}", "nats", density)
    yield Metric(f"energy_score{end}_m", f"energy score{space}", "m", C(f"energy {name}") / n)


def _band(name: str, end: str, space: str, dof: pl.Expr | int) -> Iterator[Metric]:
    """The effective samples of NEES or NIS and the band of its ratio; `dof`: the degrees of freedom of a row.

    The mean per degree of freedom of n independent rows of a perfect filter is chi-square with n·dof degrees of freedom
    over n·dof; it exceeds the limit as a normal variable exceeds z (Wilson and Hilferty 1931).
    """
    what, samples = name[:4].strip("_").upper(), C(f"n {name}") ** 2 / C(f"slow {name}")
    words = f"independent samples with the information of the rows' {what}{space}"
    yield Metric(f"n_effective{end}", words, "rows", samples)
    part = 2 / 9 / (dof * samples**2 / (samples + UNCERTAIN))
    for z, side in ((-NORMAL, "low"), (NORMAL, "high")):
        words = f"{side}est {what}/dof of a perfect filter with such errors{space}, 95 %"
        yield Metric(f"{name}_{side}", words, "", (1 - part + z * part.sqrt()).clip(lower_bound=0) ** 3)


METRICS = {
    metric.name: metric._replace(short=short, rank=rank, page=page)
    for metric in (
        Metric("n", "scored rows", "rows", C("n")),
        Metric("n_rows", "rows", "rows", C("n_rows")),
        Metric("n_no_estimate", "rows without an estimate", "rows", C("n_no_estimate")),
        Metric("n_no_truth", "rows outside the truth", "rows", C("n_no_truth")),
        Metric("n_hole", "rows in gaps of the truth", "rows", C("n_hole")),
        *(metric for kind in ERROR_KINDS for metric in _of_kind(kind)),
        Metric("variance_m2", "variance of the error", "m²", C("squares m") / C("n m") - (C("sum m") / C("n m")) ** 2),
        Metric("lag_s", "time by which estimates are late, by errors along the true path", "s", -C("along") / C("way")),
        Metric("rmse_without_lag_m", "RMSE without this", "m",
               ((C("squares m") - C("along") ** 2 / C("way")) / C("n m")).sqrt()),
        *(Metric(f"bias_{x}", f"bias in {x.split('_')[0]}", x.split("_")[1], C(f"bias {x}") / C(f"n {kind}"))
          for x, kind in BIASES.items()),
        *_consistency("nees", 2),
        *_consistency("nees_3d", 3),
        Metric("nis_ratio", "NIS per degree of freedom, 1 expected", "", C("nis") / C("dof"), right=1.0),
        *_band("nis", "_nis", "", C("dof") / C("n nis")),
        Metric("lost_s", "time lost", "s", C("lost s")),
        Metric("lost_fraction", "rows lost", "%", pl.when(C("span s") > 0).then(C("lost s") / C("span s"))
               .otherwise(C("lost rows") / C("n_rows"))),
        Metric("losses", "times lost", "", C("losses")),
        Metric("diverged", "trajectories lost at least once", "%", C("diverged") / C("trajectories")),
        Metric("failed", "trajectories without a usable estimate", "%", C("failed") / C("trajectories")),
    )
    for short, rank, page in [COLUMNS.get(metric.name, ("", 0, False))]
}  # fmt: skip
"""All metrics by name, in the order of files and tables."""
