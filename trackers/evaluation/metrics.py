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
from trackwright.trackers.evaluation.judge import band, regret
from trackwright.trackers.evaluation.rows import AXES, WHY


class Metric(NamedTuple):
    """A metric: its name, what it is in words, its unit, and its expression over the sums of groups of rows.

    `unit`: m, m², rad, s, rows, nats, % of a share, or none. `short`: the heading of its column in tables, in up to two
    lines; without one, files alone have it. `rank`: of a table too wide for the terminal, the columns of the highest
    rank are left out first. `page`: whether the page of `track` has it. `right`: its value for right covariances.
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
    "n": ("n", 0, True),
    "rmse_m": ("RMSE", 0, True),
    "median_m": ("median", 2, True),
    "p90_m": ("p90", 3, False),
    "p95_m": ("p95", 0, True),
    "p99_m": ("p99", 3, False),
    "max_m": ("max", 0, True),
    "rmse_3d_m": ("3-D\nRMSE", 0, True),
    "p95_3d_m": ("3-D\np95", 3, False),
    "rmse_heading_rad": ("heading,\n° RMSE", 0, True),
    "p95_heading_rad": ("heading,\n° p95", 3, False),
    "rmse_azimuth_rad": ("az\nRMSE", 0, True),
    "bias_azimuth_rad": ("az\nbias", 3, False),
    "rmse_elevation_rad": ("el\nRMSE", 0, True),
    "bias_elevation_rad": ("el\nbias", 3, False),
    "rmse_direction_rad": ("angle\nRMSE", 1, True),
    "median_direction_rad": ("angle\nmedian", 2, False),
    "p95_direction_rad": ("angle\np95", 0, True),
    "coverage_50": ("% in\n50 %", 1, False),
    "coverage_90": ("\n90 %", 1, False),
    "coverage_95": ("% in\n95 %", 0, True),
    "coverage_99": ("\n99 %", 1, False),
    "nees_ratio": ("NEES\n/dof", 0, True),
    "regret": ("regret", 0, True),
    "log_density": ("log\ndensity", 1, True),
    "energy_score_m": ("energy\nscore", 2, True),
    "nis_ratio": ("NIS\n/dof", 2, True),
    "lost_s": ("lost", 0, True),
}
"""The metrics with a column in tables: `short`, `rank` and `page` of `Metric`."""

ERROR_KINDS = {"m": "", "3d_m": "in 3-D", "heading_rad": "of heading", "direction_rad": "of direction",
               "azimuth_rad": "of azimuth", "elevation_rad": "of elevation"}  # fmt: skip
"""The kinds of errors by the suffix of the names of their metrics, with the words after a statistic's."""

SHARES = {"median": (0.5, "median error"), "p90": (0.9, "90th percentile"), "p95": (0.95, "95th percentile"),
          "p99": (0.99, "99th percentile")}  # fmt: skip
"""The quantiles of errors that are metrics."""

LEVELS = (50, 68, 90, 95, 99)
"""Levels, %, of the ellipses whose share of the truth is a metric."""

BIASES = {"x_m": "m", "y_m": "m", "z_m": "3d_m", "azimuth_rad": "azimuth_rad", "elevation_rad": "elevation_rad"}
"""The kind of errors whose rows count for the bias of a component."""

C = pl.col


def size_terms(kind: str) -> dict[str, pl.Expr]:
    """The terms of errors of a kind."""
    size = C(f"size_{kind}")
    return {f"n {kind}": size.is_not_null(), f"sum {kind}": size, f"squares {kind}": size**2}


def nees_terms(name: str, dof: int) -> dict[str, pl.Expr]:
    """The terms of NEES: `nees`, or `nees_3d`, which a known height does not have in any row of its track."""
    nees, space = C(name), name.removeprefix("nees")
    finite, size = nees.is_finite().fill_null(False), C("size_3d_m" if space else name)
    judged = (size.is_not_null() & nees.is_not_null().any().over("track")) if space else True
    slow, density, energy = (C(f"{what}{space}") for what in ("slow", "density", "energy"))
    return {
        f"n {name}": finite,
        f"sum {name}": pl.when(finite).then(nees),
        **{f"inside {p} {name}": nees <= chi_square_quantile(p / 100, dof) for p in LEVELS},
        f"zero {name}": C("why").is_null() & nees.is_infinite(),
        f"judged {name}": nees.is_not_null(),
        f"no {name}": C("why").is_null() & judged & ~finite,
        f"slow {name}": slow,
        f"log density {name}": density,
        f"energy {name}": energy,
    }


MEASURED = C("nis").is_finite() & (C("nis_dof") > 0)
TERMS = {
    "n": C("why").is_null(),
    "n_rows": C("track").is_not_null(),
    **{f"n_{reason.replace(' ', '_')}": (C("why") == reason).fill_null(False) for reason in WHY.values()},
    **{name: term for kind in ERROR_KINDS for name, term in size_terms(kind).items()},
    **{f"bias {x}": pl.when(C(f"size_{kind}").is_not_null()).then(C(f"error_{x}")) for x, kind in BIASES.items()},
    **nees_terms("nees", 2),
    **nees_terms("nees_3d", 3),
    "nis": pl.when(MEASURED).then(C("nis")),
    "dof": pl.when(MEASURED).then(C("nis_dof")),
    "n nis": MEASURED,
    "slow nis": C("slow_nis"),
    "lost s": pl.when(C("lost")).then(C("step_s")),
    "span s": C("step_s"),
    "lost rows": C("lost"),
    "losses": C("losses"),
}
"""What is summed over rows, by name."""

LARGEST = {f"largest {kind}": C(f"size_{kind}").max() for kind in ERROR_KINDS}
"""Largest values of groups of rows, by name."""

QUANTILES = {
    **{f"{p} {kind}": C(f"size_{kind}").quantile(p, "linear") for kind in ERROR_KINDS for p, _ in SHARES.values()},
    **{f"0.5 {name}": C(name).filter(C(name).is_finite()).quantile(0.5, "linear") for name in ("nees", "nees_3d")},
}
"""Quantiles of groups of rows, by share and kind of error, or NEES."""


Frame = TypeVar("Frame", pl.DataFrame, pl.LazyFrame)


def sums(rows: Frame, *by: str, of: Collection[str] = ()) -> Frame:
    """The `TERMS` of these rows summed by the columns `by`, or over all of them, with largest values and quantiles.

    `of`: what these metrics need, else all.
    """
    terms: dict[str, pl.Expr] = _known(_needed(TERMS, of), rows)
    others: dict[str, pl.Expr] = _known(_needed(LARGEST | QUANTILES, of), rows)
    whole = [*(C(f"term {name}").sum().alias(name) for name in terms), *_named(others)]
    flat = rows.with_columns(**{f"term {name}": x for name, x in terms.items()})
    return flat.group_by(by, maintain_order=True).agg(whole) if by else flat.select(whole)


def _needed(table: Mapping[str, pl.Expr], of: Collection[str]) -> Mapping[str, pl.Expr]:
    """What these metrics, else all, need of a table of expressions."""
    roots = {root for name in of for root in METRICS[name].expr.meta.root_names()}
    return {name: table[name] for name in table if name in roots} if of else table


def columns_of(of: Collection[str]) -> set[str]:
    """The columns of rows that these metrics need."""
    return {root for x in _needed(TERMS | LARGEST | QUANTILES, of).values() for root in x.meta.root_names()}


def added(parts: pl.DataFrame, rows: pl.LazyFrame) -> pl.DataFrame:
    """The sums of all from sums of parts (g,), and the quantiles of all their `rows`."""
    known = [name for name in QUANTILES if name in parts.columns]
    whole = parts.select(C(x).max() if x in LARGEST else C(x).sum() for x in parts.columns if x != "recording")
    return whole.with_columns(sums(rows).select(known).collect())


def metrics(of: pl.DataFrame, names: Collection[str] | None = None) -> pl.DataFrame:
    """The metrics (g,) of sums (g,), of these names or all that the sums allow; null where there are no data."""
    known = _known({name: metric.expr for name, metric in METRICS.items() if names is None or name in names}, of)
    return of.select(*_named(known)).with_columns(cs.float().fill_nan(None))


def terms_of(rows: pl.DataFrame) -> pl.DataFrame:
    """The `TERMS` (n,) of these rows, those whose columns there are."""
    return rows.select(*_named(_known(TERMS, rows)))


def _known(expressions: Mapping[str, pl.Expr], frame: pl.DataFrame | pl.LazyFrame) -> dict[str, pl.Expr]:
    """The expressions of columns that the frame has."""
    columns = {*frame.collect_schema()}
    return {name: x for name, x in expressions.items() if columns.issuperset(x.meta.root_names())}


def _named(expressions: Mapping[str, pl.Expr]) -> list[pl.Expr]:
    return [x.alias(name) for name, x in expressions.items()]


def _of_kind(kind: str) -> Iterator[Metric]:
    """The statistics of the sizes of errors of a kind."""
    n, total, squares = (C(f"{term} {kind}") for term in ("n", "sum", "squares"))
    statistics = {"rmse": ("RMSE", (squares / n).sqrt()), "mean": ("mean error", total / n)}
    statistics |= {name: (words, C(f"{share} {kind}")) for name, (share, words) in SHARES.items()}
    for name, (words, expr) in (statistics | {"max": ("largest error", C(f"largest {kind}"))}).items():
        yield Metric(f"{name}_{kind}", f"{words} {ERROR_KINDS[kind]}".strip(), _unit(kind), expr)


def _bias(component: str) -> Metric:
    """The mean error of a component."""
    words, mean = ERROR_KINDS.get(component, f"in {component[0]}"), C(f"bias {component}") / C(f"n {BIASES[component]}")
    return Metric(f"bias_{component}", f"bias {words}", _unit(component), mean)


def _unit(kind: str) -> str:
    return kind.rpartition("_")[2]


def _consistency(name: str, dof: int) -> Iterator[Metric]:
    """The metrics of NEES: `nees`, or `nees_3d`."""
    end, shape, space = ("_3d", "ellipsoid", " in 3-D") if dof == 3 else ("", "ellipse", "")
    n, mean = C(f"n {name}"), C(f"sum {name}") / C(f"n {name}")
    for what, words in (("no", "rows without a covariance"), ("zero", "rows with a zero or singular covariance")):
        yield Metric(f"n_{what}_covariance{end}", words + space, "rows", C(f"{what} {name}"))
    for p in LEVELS:
        inside = C(f"inside {p} {name}") / C(f"judged {name}")
        yield Metric(f"coverage_{p}{end}", f"inside the {p} % {shape}", "%", inside, right=p / 100)
    yield Metric(f"{name}_mean", f"NEES{space}, {dof} expected", "", mean, right=float(dof))
    yield Metric(f"{name}_ratio", f"NEES per degree of freedom{space}, 1 expected", "", mean / dof, right=1.0)
    lost = f"log density lost by the scale of the covariances{space}"
    yield Metric(f"regret{end}", lost, "nats", regret(mean / dof))
    yield from _band(name, end, space, dof)
    density = C(f"log density {name}") / n
    yield Metric(f"log_density{end}", f"mean log density of the true position{space}", "nats", density)
    yield Metric(f"energy_score{end}_m", f"energy score{space}", "m", C(f"energy {name}") / n)
    # Above 1 the 50 % ellipse holds less than half of the truth.
    factor = (C(f"0.5 {name}") / chi_square_quantile(0.5, dof)).sqrt()
    yield Metric(f"sigma_factor{end}", f"reported standard deviations too small{space} by a factor of", "", factor)


def _band(name: str, end: str, space: str, dof: pl.Expr | int) -> Iterator[Metric]:
    """The effective samples of NEES or NIS and the band of its ratio; `dof`: the degrees of freedom of a row."""
    what, samples = name[:4].strip("_").upper(), C(f"n {name}") ** 2 / C(f"slow {name}")
    words = f"independent samples with the information of the rows' {what}{space}"
    yield Metric(f"n_effective{end}", words, "rows", samples)
    for z, side in ((-NORMAL, "low"), (NORMAL, "high")):
        words = f"{side}est {what}/dof of a perfect filter with such errors{space}, 95 %"
        yield Metric(f"{name}_{side}", words, "", band(samples, dof, z))


METRICS = {
    metric.name: metric._replace(short=short, rank=rank, page=page)
    for metric in (
        Metric("n", "scored rows", "rows", C("n")),
        Metric("n_rows", "rows", "rows", C("n_rows")),
        Metric("n_no_estimate", "rows without an estimate", "rows", C("n_no_estimate")),
        Metric("n_no_truth", "rows outside the truth", "rows", C("n_no_truth")),
        Metric("n_hole", "rows in gaps of the truth", "rows", C("n_hole")),
        *_of_kind("m"),
        Metric("variance_m2", "variance of the error", "m²", C("squares m") / C("n m") - (C("sum m") / C("n m")) ** 2),
        *_of_kind("3d_m"),
        *map(_bias, AXES),
        *_of_kind("heading_rad"),
        *_of_kind("azimuth_rad"),
        _bias("azimuth_rad"),
        *_of_kind("elevation_rad"),
        _bias("elevation_rad"),
        *_of_kind("direction_rad"),
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
