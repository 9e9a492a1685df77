"""The kinds of errors, and the metrics: each is one entry, and appears in every file; README.md says where else.

A formula takes the sums of `Scores`; another sum, as of a share above a threshold, is added to `error_sums` there.

Names are those of `--fail-if`, of evaluation.json and of the metrics of a study, in metres and radians, horizontal
unless the name has `3d`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from trackwright.trackers.core.data.consistency import NORMAL, chi_square_quantile
from trackwright.trackers.evaluation.judge import band, regret
from trackwright.trackers.evaluation.scores import LEVELS, Scores

Formula = Callable[[Scores], np.ndarray]


class Metric(NamedTuple):
    """A metric: its name, what it is in words, its unit, and its formula (g,) of the scores of g groups.

    `unit`: m, m², rad, s, rows, nats, % of a share, or none. `short`: the heading of its column in tables, in up to two
    lines; without one, files alone have it. `rank`: of a table too wide for the terminal, the columns of the highest
    rank are left out first. `page`: whether the page of `track` has it. `right`: its value for right covariances.
    """

    name: str
    words: str
    unit: str
    formula: Formula
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


def position_sizes(errors: np.ndarray) -> dict[str, np.ndarray]:
    """The sizes (…) of errors (…, 3), m, by kind, the main one first; NaN of rows without one."""
    flat, height = np.hypot(errors[..., 0], errors[..., 1]), errors[..., 2]
    # Of known heights they are the same numbers, since the root of a number's square is exactly that number.
    return {"m": flat, "3d_m": np.sqrt(flat * flat + height**2) if height.any() else flat}


def bearing_sizes(estimates: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The errors (…, 2) of azimuth and elevation, rad, and their sizes (…) by kind, the main one first."""
    errors = estimates - truth
    errors[..., 0] = np.pi - (np.pi - errors[..., 0]) % (2 * np.pi)
    (x, y, z), (p, q, r) = _direction(estimates), _direction(truth)
    cross = np.sqrt((y * r - z * q) ** 2 + (z * p - x * r) ** 2 + (x * q - y * p) ** 2)
    # arctan2 of sine and cosine: the arc cosine alone is zero below 1e-8 rad.
    sizes = {"direction_rad": np.arctan2(cross, x * p + z * r + y * q)}
    return errors, sizes | {"azimuth_rad": np.abs(errors[..., 0]), "elevation_rad": np.abs(errors[..., 1])}


def _direction(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The components of the unit vectors of angles (…, 2)."""
    azimuth, elevation = angles[..., 0], angles[..., 1]
    flat = np.cos(elevation)
    return np.sin(azimuth) * flat, np.sin(elevation), np.cos(azimuth) * flat


def _ratio(numerator: str, denominator: str, more: str = "") -> Formula:
    return lambda s: s[numerator] / (s[denominator] + s.sums.get(more, 0))


def _quantile(kind: str, share: float) -> Formula:
    return lambda s: s.quantile(kind, share)


def _largest(kind: str) -> Formula:
    return lambda s: s.largest[kind]


def _of_kind(kind: str) -> Iterator[Metric]:
    """The statistics of the sizes of errors of a kind."""
    statistics: tuple[tuple[str, str, Formula], ...] = (
        ("rmse", "RMSE", lambda s: np.sqrt(s[f"squares {kind}"] / s[f"n {kind}"])),
        ("mean", "mean error", _ratio(f"sum {kind}", f"n {kind}")),
        ("median", "median error", _quantile(kind, 0.5)),
        ("p90", "90th percentile", _quantile(kind, 0.9)),
        ("p95", "95th percentile", _quantile(kind, 0.95)),
        ("p99", "99th percentile", _quantile(kind, 0.99)),
        ("max", "largest error", _largest(kind)),
    )
    for name, words, formula in statistics:
        words = f"{words} {ERROR_KINDS[kind].words}".strip()
        yield _shown(kind, name, Metric(f"{name}_{kind}", words, _unit(kind), formula))


def _bias(component: str, kind: str) -> Metric:
    """The mean error of a component, of the rows with errors of a kind."""
    words = f"bias {ERROR_KINDS[component].words if component in ERROR_KINDS else f'in {component[0]}'}"
    formula = _ratio(f"bias {component}", f"n {kind}")
    return _shown(component, "bias", Metric(f"bias_{component}", words, _unit(component), formula))


def _shown(kind: str, name: str, metric: Metric) -> Metric:
    if kind not in ERROR_KINDS or name not in ERROR_KINDS[kind].shown:
        return metric
    rank, page = ERROR_KINDS[kind].shown[name]
    return metric._replace(short=ERROR_KINDS[kind].short + name.replace("rmse", "RMSE"), rank=rank, page=page)


def _unit(kind: str) -> str:
    return kind.rpartition("_")[2]


def _consistency(name: str, dof: int) -> Iterator[Metric]:
    """The metrics of NEES: `nees`, with columns in tables, or `nees_3d`."""
    flat, suffix = name == "nees", name.removeprefix("nees")
    shape, space = ("ellipse", "") if flat else ("ellipsoid", " in 3-D")
    columns = {50: ("% in\n50 %", 1), 90: ("\n90 %", 1), 95: ("% in\n95 %", 0), 99: ("\n99 %", 1)} if flat else {}
    for what, words in (("no", "rows without a covariance"), ("zero", "rows with a zero or singular covariance")):
        yield Metric(f"n_{what}_covariance{suffix}", words + space, "rows", itemgetter(f"{what} {name}"))
    for p in LEVELS:
        short, rank = columns.get(p, ("", 0))
        formula = _ratio(f"inside {p} {name}", f"n {name}", f"zero {name}")
        words = f"inside the {p} % {shape}"
        yield Metric(f"coverage_{p}{suffix}", words, "%", formula, short, rank, flat and p == 95, p / 100)
    mean = _ratio(f"sum {name}", f"n {name}")
    yield Metric(f"{name}_mean", f"NEES{space}, {dof} expected", "", mean, right=float(dof))
    words, short = f"NEES per degree of freedom{space}, 1 expected", "NEES\n/dof" if flat else ""

    def ratio(s: Scores) -> np.ndarray:
        return mean(s) / dof

    yield Metric(f"{name}_ratio", words, "", ratio, short, 0, flat, 1.0)
    words = f"log density lost by the scale of the covariances{space}"
    yield Metric(f"regret{suffix}", words, "nats", lambda s: regret(ratio(s)), "regret" * flat, 0, flat)
    yield from _band(name, space, lambda s: dof)
    words, density = f"mean log density of the true position{space}", _ratio(f"log density {name}", f"n {name}")
    yield Metric(f"log_density{suffix}", words, "nats", density, "log\ndensity" * flat, 1, flat)
    energy = _ratio(f"energy {name}", f"n {name}")
    yield Metric(f"energy_score{suffix}_m", f"energy score{space}", "m", energy, "energy\nscore" * flat, 2, flat)
    small = f"reported standard deviations too small{space} by a factor of"
    middle = chi_square_quantile(0.5, dof)
    # Above 1 the 50 % ellipse holds less than half of the truth.
    yield Metric(f"sigma_factor{suffix}", small, "", lambda s: np.sqrt(s.quantile(name, 0.5) / middle))


def _band(name: str, space: str, dof: Callable[[Scores], np.ndarray | int]) -> Iterator[Metric]:
    """The effective samples of NEES or NIS and the band of its ratio; `dof`: the degrees of freedom of a row (g,)."""
    what, end = name[:4].strip("_").upper(), name.removeprefix("nees_") if name != "nees" else ""

    def samples(s: Scores) -> np.ndarray:
        return s[f"n {name}"] ** 2 / s[f"slow {name}"]

    words = f"independent samples with the information of the rows' {what}{space}"
    yield Metric(f"n_effective{end and '_'}{end}", words, "rows", samples)
    for z, side in ((-NORMAL, "low"), (NORMAL, "high")):
        words = f"{side}est {what}/dof of a perfect filter with such errors{space}, 95 %"
        yield Metric(f"{name}_{side}", words, "", partial(lambda z, s: band(samples(s), dof(s), z), z))


def _lost_fraction(s: Scores) -> np.ndarray:
    rows = s["lost rows"] / s["n_rows"]
    return np.where(s["span s"] > 0, s["lost s"] / s["span s"], rows) if "span s" in s.sums else rows


def _variance(s: Scores) -> np.ndarray:
    return s["squares m"] / s["n m"] - (s["sum m"] / s["n m"]) ** 2


RESIDUALS = {
    "residual_ratio_5s": ("residuals' 5 s means, relative to most residuals", ""),
    "residual_part_5s": ("part of the residuals' square that lasts 5 s", "%"),
}
"""The metrics of `residual_ratios`, of recordings alone: words and unit."""

METRICS = {
    metric.name: metric
    for metric in (
        Metric("n", "scored rows", "rows", lambda s: s["n"], "n", 0, True),
        Metric("n_rows", "rows", "rows", lambda s: s["n_rows"]),
        Metric("n_no_estimate", "rows without an estimate", "rows", lambda s: s["n_no_estimate"]),
        Metric("n_no_truth", "rows outside the truth", "rows", lambda s: s["n_no_truth"]),
        Metric("n_hole", "rows in gaps of the truth", "rows", lambda s: s["n_hole"]),
        *_of_kind("m"),
        Metric("variance_m2", "variance of the error", "m²", _variance),
        *_of_kind("3d_m"),
        _bias("x_m", "m"),
        _bias("y_m", "m"),
        _bias("z_m", "3d_m"),
        *_of_kind("heading_rad"),
        *_of_kind("azimuth_rad"),
        _bias("azimuth_rad", "azimuth_rad"),
        *_of_kind("elevation_rad"),
        _bias("elevation_rad", "elevation_rad"),
        *_of_kind("direction_rad"),
        *_consistency("nees", 2),
        *_consistency("nees_3d", 3),
        Metric(
            "nis_ratio", "NIS per degree of freedom, 1 expected", "", _ratio("nis", "dof"), "NIS\n/dof", 2, True, 1.0
        ),
        *_band("nis", "", _ratio("dof", "n nis")),
        *(Metric(name, *about, _largest(name)) for name, about in RESIDUALS.items()),
        Metric("lost_s", "time lost", "s", lambda s: s["lost s"], "lost", 0, True),
        Metric("lost_fraction", "rows lost", "%", _lost_fraction),
        Metric("losses", "times lost", "", lambda s: s["losses"]),
        Metric("diverged", "trajectories lost at least once", "%", _ratio("diverged", "trajectories")),
        Metric("failed", "trajectories without a usable estimate", "%", _ratio("failed", "trajectories")),
    )
}
"""All metrics by name, in the order of files and tables."""


def metrics(scores: Scores) -> dict[str, np.ndarray]:
    """The metrics (g,) of g groups: those whose sums the scores have; NaN where there are no data."""
    values = {}
    with np.errstate(invalid="ignore", divide="ignore"):
        for name, metric in METRICS.items():
            try:
                values[name] = metric.formula(scores)
            except KeyError:  # of other estimates, or of sums that are not taken
                continue
    return values


class MetricRows(Sequence[dict[str, Any]]):
    """The metrics of each of g groups by name, None where there are no data; `labels` (g,) by name go before.

    Computed when the first is asked for.
    """

    def __init__(self, scores: Scores, labels: Mapping[str, Sequence[str]] | None = None) -> None:
        self._scores, self._labels = scores, labels or {}

    @cached_property
    def _columns(self) -> dict[str, Sequence[Any]]:
        columns: dict[str, Sequence[Any]] = {**self._labels}
        for name, values in metrics(self._scores).items():
            missing = np.isnan(values)
            columns[name] = [None if x != x else x for x in values.tolist()] if missing.any() else values.tolist()
        return columns

    def __len__(self) -> int:
        return len(self._scores["n"])

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[k] for k in range(len(self))[index]]
        return {name: values[index] for name, values in self._columns.items()}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and [*self] == [*other]

    def __repr__(self) -> str:
        return repr([*self])
