"""The tables and the chart of the benchmark: a row a data set, a column an estimator."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from trackwright.experiments.lab.benchmark.data import folder_of, hint
from trackwright.experiments.lab.benchmark.declaration import DEFAULT, DEVELOPMENT, ESTIMATORS, MOTION, OPTIMUM
from trackwright.experiments.lab.benchmark.scoring import Cell, cell, difference, files
from trackwright.experiments.lab.cases import Row, Table, as_page, as_text, machine, packages
from trackwright.experiments.pages.charts.style import LINES, write_panels
from trackwright.experiments.text.tables import replace_tables
from trackwright.experiments.text.wording import fixed
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.statements import COVERAGE, RATIO

MARK = "trackwright benchmark"
CHART = "side-by-side.png"
APART = (*DEFAULT, *MOTION, *OPTIMUM)
"""The estimators that ours is not compared with."""

Pair = tuple[str, str]
"""Ours, filtered and smoothed."""

Cells = Mapping[str, Mapping[str, Cell]]
"""By data set and estimator."""


UNKNOWN = "?"


class Tally(NamedTuple):
    """On how many data sets ours is better, equal within the paired interval, and of these without one; those where it
    is worse.
    """

    better: int
    equal: int
    unknown: int
    worse: tuple[str, ...]


def scored(source: Path, sets: Sequence[str]) -> Cells:
    """The cells of all files of a folder, or of one file, that are of these data sets."""
    if source.is_file():
        name = source.name.split(".")[0]
        found = {"mine": {name: source}}
    elif source.is_dir():
        found = files(source)
    else:
        raise UnusableInput(f"{source}: no such file or folder; expected estimates: ESTIMATOR/DATASET.tum")
    wanted = dict.fromkeys(name for of_one in found.values() for name in of_one)
    if not (common := [name for name in sets if name in wanted]):
        raise UnusableInput(
            f"{source}: estimates of {', '.join(wanted)}; expected data sets: {', '.join(sets)}{hint()}"
        )
    order = [name for name in (*ESTIMATORS, *found) if name in found]
    return {
        name: {e: cell(found[e][name], folder) for e in dict.fromkeys(order) if name in found[e]}
        for name in common
        for folder in [folder_of(name)]
    }


def show(results: Cells, page: Path | None) -> None:
    """Prints the tables, and writes those of a page with its chart."""
    tables = list(_tables(results))
    for table in tables:
        print(as_text(table), end="\n\n")
    if page is None:
        return
    write_chart(page.with_name(CHART), results)
    host, command = machine(), "trackwright benchmark --page docs/side-by-side.md"
    versions = ", ".join(f"{name} {text}" for name, text in packages().items())
    heading = f"{host['cpu']}, {host['cores']} cores, `{command}`; {versions}."
    replace_tables(page, MARK, as_page(heading, tables))
    print(f"wrote {page} and {CHART}", file=sys.stderr)


def _tables(results: Cells) -> Iterator[Table]:
    for ours, title in ((DEFAULT, "Ours against each"), (MOTION, "Ours with `--motion auto` against each")):
        if tallies := list(_against(results, ours)):
            rows = [_tally_row(name, tally, ours) for name, tally in tallies]
            yield Table(rows, title, _ahead(results, ours, [tally for _, tally in tallies]))
    yield Table([_summary(name, results) for name in _estimators(results)], "Estimators")
    yield Table([_row(name, results[name], "rmse", 3) for name in results], "RMSE", NOTE)
    yield Table([_row(name, results[name], "p75", 3) for name in results], "75th percentile")
    yield Table([_row(name, results[name], "p95", 3) for name in results], "95th percentile")
    yield Table([_row(name, results[name], "inside", 1, 100.0) for name in results], "Inside the 95 % ellipse, %")
    yield Table([_row(name, results[name], "nees", 2) for name in results], "NEES per degree of freedom")
    yield Table([_row(name, results[name], "cpu", 1) for name in results], "Processor time of a reading, µs")
    failures = [
        {"data set": name, "estimator": e, "reason": one.failed}
        for name, of_set in results.items() for e, one in of_set.items() if one.failed
    ]  # fmt: skip
    if failures:
        yield Table(failures, "Failures")


def _ahead(results: Cells, ours: Pair, tallies: Sequence[Tally]) -> str:
    """On how many data sets ours is ahead of every other estimator, or equal, and what that means."""
    sets = _compared(results, _estimators(results), ours)
    ahead = [name for name in sets if not any(name in tally.worse for tally in tallies)]
    unproven = sum(any(_is_unproven(e, results[name], ours) for e in results[name]) for name in ahead)
    return (
        f"Ahead of, or equal to, every other estimator on {len(ahead)} of {len(sets)} data sets "
        f"({100 * len(ahead) / len(sets):.0f} %; goal: 80 %). Equal: the interval has zero in it, or there is none "
        f"(fewer than five pieces); without one, another has a smaller RMSE on {unproven} of these {len(ahead)}. "
        "A failure is worse than any error."
    )


NOTE = (
    "Horizontal, m; of ble51-uca the angle of direction, rad. *: levels were chosen on it, those of others and, "
    "except tiers, ours. Bold: the least of its row; ↓: better than ours of its kind beyond the "
    "paired 95 % interval; ↑: worse; ?: no interval, with fewer than five pieces of time."
)


def _estimators(results: Cells) -> list[str]:
    return list(dict.fromkeys(name for of_set in results.values() for name in of_set))


def _compared(results: Cells, names: Sequence[str], ours: Pair = DEFAULT) -> list[str]:
    """The data sets that have one of these estimators, and ours of its kind."""
    others = [name for name in names if name not in APART]
    return [s for s, of_set in results.items() if any(e in of_set and counterpart(e, ours) in of_set for e in others)]


def counterpart(name: str, ours: Pair = DEFAULT) -> str:
    """Our estimator that another is compared with: the smoothed one where it uses later readings, too."""
    return ours[name in ESTIMATORS and ESTIMATORS[name].later]


def _judged(name: str, of_set: Mapping[str, Cell], ours: Pair = DEFAULT) -> str:
    """Whether an estimator has a smaller (↓) or larger (↑) RMSE than ours beyond the interval, or ours or it alone
    failed; `UNKNOWN` without an interval, else empty.
    """
    mine = of_set.get(counterpart(name, ours))
    if name in APART or mine is None or name not in of_set:
        return ""
    paired = difference(mine, of_set[name])
    if paired is None:
        return {(True, False): "↓", (False, True): "↑"}.get((bool(mine.failed), bool(of_set[name].failed)), "")
    if np.isnan(paired.low):
        return UNKNOWN
    return "↓" if paired.high < 0 else "↑" if paired.low > 0 else ""


def _is_unproven(name: str, of_set: Mapping[str, Cell], ours: Pair) -> bool:
    """Whether an estimator has a smaller RMSE than ours, without an interval."""
    return _judged(name, of_set, ours) == UNKNOWN and of_set[name].rmse < of_set[counterpart(name, ours)].rmse


def _against(results: Cells, ours: Pair = DEFAULT) -> Iterator[tuple[str, Tally]]:
    for name in _estimators(results):
        if name in APART:
            continue
        signs = {s: _judged(name, results[s], ours) for s in _compared(results, [name], ours)}
        worse = tuple(s for s, sign in signs.items() if sign == "↓")
        better = sum(sign == "↑" for sign in signs.values())
        if signs:
            unknown = sum(sign == UNKNOWN for sign in signs.values())
            yield name, Tally(better, len(signs) - better - len(worse), unknown, worse)


def _tally_row(name: str, tally: Tally, ours: Pair) -> Row:
    return {
        "estimator": name, "ours": counterpart(name, ours), "ours better": tally.better, "equal": tally.equal,
        "of these without an interval": tally.unknown,
        "ours worse": len(tally.worse), "worse on": ", ".join(tally.worse),
    }  # fmt: skip


def _summary(name: str, results: Cells) -> Row:
    mine = [of_set[name] for of_set in results.values() if name in of_set]
    (least, most), (low, high) = COVERAGE, RATIO
    with_covariance = [one for one in mine if one.inside is not None and one.nees is not None]
    held = sum(least <= one.inside <= most and low <= one.nees <= high for one in with_covariance)  # type: ignore[operator]
    missing = [one.missing for one in mine if not one.failed]
    times = [one.cpu for one in mine if one.cpu is not None]
    estimator = ESTIMATORS.get(name)
    return {
        "estimator": name,
        "what": estimator.about if estimator else "submitted",
        "levels": estimator.levels if estimator else "",
        "data sets": len(mine),
        "failures": sum(bool(one.failed) for one in mine),
        "readings without an estimate, %": fixed(100 * float(np.mean(missing)), 1) if missing else "",
        "covariances hold": f"{held} of {len(with_covariance)}" if with_covariance else "none reported",
        "µs a reading, median": fixed(float(np.median(times)), 1) if times else "",
    }


def _row(name: str, of_set: Mapping[str, Cell], field: str, digits: int, factor: float = 1.0) -> Row:
    developed = any(name in names for names in DEVELOPMENT.values())
    row: Row = {"data set": name + "*" * developed}
    values = {e: getattr(one, field) for e, one in of_set.items() if not one.failed}
    known = [value for value in values.values() if value is not None]
    for e, one in of_set.items():
        value = values.get(e)
        if one.failed:
            row[e] = "failed"
        elif value is None:
            row[e] = ""
        else:
            text = fixed(factor * value, digits)
            if field == "rmse":
                text = f"**{text}**" if value == min(known) else text
                text += f" {_judged(e, of_set)}".rstrip()
            row[e] = text
    return row


def write_chart(path: Path, results: Cells) -> None:
    """The RMSE of each estimator relative to ours of its kind, a line a data set."""
    shown = _compared(results, _estimators(results))
    write_panels(
        path,
        [partial(_draw, results, shown, later) for later in (False, True)],
        (11.0, 0.2 * len(shown) + 1.8),
        columns=2,
        legend=0,
        sharey=True,
    )


def _draw(results: Cells, shown: Sequence[str], later: bool, axes: Axes) -> None:
    ours = DEFAULT[later]
    others = [e for e in _estimators(results) if e not in APART and counterpart(e) == ours]
    for k, name in enumerate(others):
        rows = [row for row, s in enumerate(shown) if ours in results[s] and name in results[s]]
        ratios = [results[shown[row]][name].rmse / results[shown[row]][ours].rmse for row in rows]
        axes.scatter(
            np.clip(ratios, *SPAN),
            rows,
            s=26,
            color=LINES[k % len(LINES)],
            marker=MARKERS[k % len(MARKERS)],
            label=name,
            zorder=3,
        )
    axes.axvline(1.0, color="black", linewidth=1.5, label=ours)
    axes.set(
        xscale="log", xlim=(SPAN[0] / 1.1, SPAN[1] * 1.1), xlabel=f"RMSE relative to {ours}; left: better than ours"
    )
    axes.set_xticks([0.5, 1, 2, 5], ["0.5", "1", "2", "5"])
    axes.set_xticks([], minor=True)
    axes.set_yticks(range(len(shown)), shown)
    axes.set_ylim(len(shown) - 0.5, -0.5)
    axes.grid(axis="y", linewidth=0.3)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, fontsize=8)


SPAN = (0.3, 6.0)
"""Least and largest ratio drawn; those beyond are at the edge."""

MARKERS = ("o", "s", "^", "D", "v", "P", "X")
