"""The table of metrics. A metric is one entry: its words and an expression over sums of scored rows.

Sums add up over tracks, recordings and the trajectories of a study, which takes its metrics from here as well. Names
are those of `--fail-if`, of evaluation.json and of a study, in metres and radians, horizontal unless they have `3d`.
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


class ErrorKind(NamedTuple):
    """A kind of errors: words that follow those of a statistic, and how the headings of its columns begin.

    `shown`: rank and page, as of `Metric`, of the statistics that have a column.
    """

    words: str
    short: str
    shown: Mapping[str, tuple[int, bool]]


ERROR_KINDS = {
    "m": ErrorKind("", "", {"rmse": (0, True), "median": (2, True), "p90": (3, False), "p95": (0, True),
                            "p99": (3, False), "max": (0, True)}),
    "3d_m": ErrorKind("in 3-D", "3-D\n", {"rmse": (0, True), "p95": (3, False)}),
    "heading_rad": ErrorKind("of heading", "heading,\n° ", {"rmse": (0, True), "p95": (3, False)}),
    "direction_rad": ErrorKind("of direction", "angle\n", {"rmse": (1, True), "median": (2, False), "p95": (0, True)}),
    "azimuth_rad": ErrorKind("of azimuth", "az\n", {"rmse": (0, True), "bias": (3, False)}),
    "elevation_rad": ErrorKind("of elevation", "el\n", {"rmse": (0, True), "bias": (3, False)}),
}  # fmt: skip
"""The kinds of errors by the suffix of the names of their metrics."""

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
    """The sums of all from those of parts (g,), and the quantiles of all their `rows`."""
    most, known = {*LARGEST, *RESIDUALS}, [name for name in QUANTILES if name in parts.columns]
    whole = parts.select(C(x).max() if x in most else C(x).sum() for x in parts.columns if parts[x].dtype != pl.String)
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
        yield _shown(kind, name, f"{words} {ERROR_KINDS[kind].words}".strip(), expr)


def _bias(component: str) -> Metric:
    """The mean error of a component."""
    words = f"bias {ERROR_KINDS[component].words if component in ERROR_KINDS else f'in {component[0]}'}"
    return _shown(component, "bias", words, C(f"bias {component}") / C(f"n {BIASES[component]}"))


def _shown(kind: str, name: str, words: str, expr: pl.Expr) -> Metric:
    metric = Metric(f"{name}_{kind}", words, kind.rpartition("_")[2], expr)
    if kind not in ERROR_KINDS or name not in ERROR_KINDS[kind].shown:
        return metric
    rank, page = ERROR_KINDS[kind].shown[name]
    return metric._replace(short=ERROR_KINDS[kind].short + name.replace("rmse", "RMSE"), rank=rank, page=page)


def _consistency(name: str, dof: int) -> Iterator[Metric]:
    """The metrics of NEES: `nees`, with columns in tables, or `nees_3d`."""
    flat, end = name == "nees", name.removeprefix("nees")
    shape, space = ("ellipse", "") if flat else ("ellipsoid", " in 3-D")
    columns = {50: ("% in\n50 %", 1), 90: ("\n90 %", 1), 95: ("% in\n95 %", 0), 99: ("\n99 %", 1)} if flat else {}
    n, mean = C(f"n {name}"), C(f"sum {name}") / C(f"n {name}")
    for what, words in (("no", "rows without a covariance"), ("zero", "rows with a zero or singular covariance")):
        yield Metric(f"n_{what}_covariance{end}", words + space, "rows", C(f"{what} {name}"))
    for p in LEVELS:
        short, rank = columns.get(p, ("", 0))
        expr, words = C(f"inside {p} {name}") / C(f"judged {name}"), f"inside the {p} % {shape}"
        yield Metric(f"coverage_{p}{end}", words, "%", expr, short, rank, flat and p == 95, p / 100)
    yield Metric(f"{name}_mean", f"NEES{space}, {dof} expected", "", mean, right=float(dof))
    words = f"NEES per degree of freedom{space}, 1 expected"
    yield Metric(f"{name}_ratio", words, "", mean / dof, "NEES\n/dof" * flat, 0, flat, 1.0)
    words = f"log density lost by the scale of the covariances{space}"
    yield Metric(f"regret{end}", words, "nats", regret(mean / dof), "regret" * flat, 0, flat)
    yield from _band(name, end, space, dof)
    words, density = f"mean log density of the true position{space}", C(f"log density {name}") / n
    yield Metric(f"log_density{end}", words, "nats", density, "log\ndensity" * flat, 1, flat)
    energy = C(f"energy {name}") / n
    yield Metric(f"energy_score{end}_m", f"energy score{space}", "m", energy, "energy\nscore" * flat, 2, flat)
    words = f"reported standard deviations too small{space} by a factor of"
    # Above 1 the 50 % ellipse holds less than half of the truth.
    yield Metric(f"sigma_factor{end}", words, "", (C(f"0.5 {name}") / chi_square_quantile(0.5, dof)).sqrt())


def _band(name: str, end: str, space: str, dof: pl.Expr | int) -> Iterator[Metric]:
    """The effective samples of NEES or NIS and the band of its ratio; `dof`: the degrees of freedom of a row."""
    what, samples = name[:4].strip("_").upper(), C(f"n {name}") ** 2 / C(f"slow {name}")
    words = f"independent samples with the information of the rows' {what}{space}"
    yield Metric(f"n_effective{end}", words, "rows", samples)
    for z, side in ((-NORMAL, "low"), (NORMAL, "high")):
        words = f"{side}est {what}/dof of a perfect filter with such errors{space}, 95 %"
        yield Metric(f"{name}_{side}", words, "", band(samples, dof, z))


RESIDUALS = {
    "residual_ratio_5s": ("residuals' 5 s means, relative to most residuals", ""),
    "residual_part_5s": ("part of the residuals' square that lasts 5 s", "%"),
}
"""The metrics of `residual_ratios`, of recordings alone: words and unit."""

METRICS = {
    metric.name: metric
    for metric in (
        Metric("n", "scored rows", "rows", C("n"), "n", 0, True),
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
        Metric("nis_ratio", "NIS per degree of freedom, 1 expected", "", C("nis") / C("dof"), "NIS\n/dof", 2, True,
               1.0),
        *_band("nis", "_nis", "", C("dof") / C("n nis")),
        *(Metric(name, *about, C(name)) for name, about in RESIDUALS.items()),
        Metric("lost_s", "time lost", "s", C("lost s"), "lost", 0, True),
        Metric("lost_fraction", "rows lost", "%", pl.when(C("span s") > 0).then(C("lost s") / C("span s"))
               .otherwise(C("lost rows") / C("n_rows"))),
        Metric("losses", "times lost", "", C("losses")),
        Metric("diverged", "trajectories lost at least once", "%", C("diverged") / C("trajectories")),
        Metric("failed", "trajectories without a usable estimate", "%", C("failed") / C("trajectories")),
    )
}  # fmt: skip
"""All metrics by name, in the order of files and tables."""
