"""What tables and the rig alone tell: a check of values is a row of a table, everything else a short function.

A stream is the rows of one sensor and one tag in one table; order, gaps and outliers are defined along a stream.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from trackwright.trackers.core.data.seconds import HOLE_M, HOLE_S, moment, place_in_time, span, zero_of
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.rig import ELSEWHERE_M, Rig
from trackwright.trackers.core.wording import counted, significant
from trackwright.trackers.recordings.checks import CheckResult, Level
from trackwright.trackers.recordings.columns import TableRows
from trackwright.trackers.recordings.kinds import KINDS, QUATERNION, Kind, duplicates_line, first_time, table_kinds
from trackwright.trackers.recordings.truth import TruePaths, TruthStatus

Tables = Mapping[str, pl.DataFrame]
Results = Iterator[CheckResult]
Place = Callable[[Mapping[str, Any]], str]
C, DT, T, X, SIZE, BOUND = pl.col, pl.col("dt"), pl.col("t_s"), pl.col("x"), pl.col("x").abs(), pl.col("bound")
JUMP_S, YEAR_S, NANOSECOND_M, FAR_M = 1e7, 31_557_600.0, 0.2998, 500.0
"""Step that is a jump of the clock and no gap, s; a year, s; metres a nanosecond; reach of indoor radio, m."""

LEAST_JUMP = {"m": 1.0, "mps": 5.0, "mps2": 20.0, "radps": 5.0}
"""Least jumps of outliers by unit: smaller ones are within reach of a person, cart or drone between two rows."""

STREAMS_SHOWN, LEAST_STAMPS, OFF_M, OFFSET_M, POINTS = 24, 10, 0.5, 0.1, 400
"""Streams of a table with a line each; rows that cannot all have one time; by how much heights, and places of tags on
a body (m, and share), are off by a mistake; places of a path that are looked at."""


class Rule(NamedTuple):
    """A line where more than a share `above` of the values of a nature `of` is `broken`."""

    level: Level
    of: str
    broken: pl.Expr
    sentence: str
    above: float = 0.0


def _near(size: float) -> pl.Expr:
    return (SIZE.median() - size).abs() <= 0.15 * size


def _spike(reach: int) -> pl.Expr:
    """Beyond both neighbours in the stream by ten times the scatter of its steps."""
    sides = [X.shift(way).over("stream") for way in (reach, -reach)]
    far = (X - X.clip(pl.min_horizontal(sides), pl.max_horizontal(sides))).abs() > (14.826 * C("steps")).clip(BOUND)
    return far.fill_null(False) & pl.all_horizontal(side.is_not_null() for side in sides)


_BEYOND, _TYPICAL = SIZE > BOUND + 1e-3, "typical {name} {typical:,.4g} "  # with room for π rounded up in text
_TURNED = (
    X.is_between(-1e-3, 2 * math.pi + 1e-3) & (((X + math.pi) % (2 * math.pi) - math.pi).abs() <= BOUND + 1e-3)
).all()
_MANY = (C("away") > (14.826 * C("away").median().over("stream")).clip(2 * BOUND)) & (C("steps") > 3 * BOUND)
_GRAVITY_IN = {"multiples of g": 1.0, "ft/s²": 32.2, "thousandths of g or cm/s²": 1000.0, "mm/s²": 9810.0}
_ODD = ~pl.any_horizontal(*map(_near, (9.81, *_GRAVITY_IN.values())))
_LONG, _NARROW = SIZE.median() > BOUND, (X.std() < 0.05 * SIZE.median()).fill_null(False)
_FAR = (SIZE * NANOSECOND_M > BOUND).mean() > 0.1
_LIES, _VALUES = (
    "{share:.0%} of {name} lie beyond ±{bound:.3g}: looks like ",
    "values of {name} beyond ±{bound:.3g}: {n}; ",
)
_EXCEED = "{share:.0%} of {name} exceed the distance of their anchors: looks like "

UNITS = (
    Rule("error", "phases", SIZE.median() > 2 * math.pi, _TYPICAL + "rad: looks like degrees, expected (-π, π]"),
    Rule("warning", "phases", _BEYOND & (SIZE.median() <= 2 * math.pi), "{name} are not wrapped to (-π, π]; harmless, "
         "since trackers wrap phase differences", 0.01),
    Rule("error", "gyro", SIZE.quantile(0.95) > 35.0,  # the full scale of common gyroscopes
         "turn rates beyond 35 rad/s: looks like degrees per second, expected radians"),
    Rule("error", "rad", _BEYOND & ~_TURNED, _LIES + "degrees, expected radians", 0.1),
    Rule("error", "radps", _BEYOND, _LIES + "degrees per second, expected radians", 0.1),
    Rule("error", "mps", _BEYOND, _LIES + "millimetres or centimetres per second, expected metres", 0.1),
    # Places in millimetres are as far from one another as from the rig; places in another frame are not.
    Rule("error", "place", _LONG & _NARROW, _TYPICAL + "m: looks like another frame than the rig's, or millimetres"),
    Rule("error", "place", _LONG & ~_NARROW, _TYPICAL + "m{site}: looks like centimetres or millimetres"),
    Rule("error", "m", SIZE.median() > 7.5 * BOUND, _TYPICAL + "m{site}: looks like millimetres"),
    Rule("error", "m", _LONG & (SIZE.median() <= 7.5 * BOUND), _TYPICAL + "m{site}: looks like centimetres"),
    # A difference in seconds is at most 1e-6 in 300 m; in metres some exceed their resolution.
    Rule("error", "difference", SIZE.max() < 1e-5, "{name} below 1e-5 m: looks like seconds, expected metres"),
    Rule("error", "difference", (SIZE > BOUND) & ~_FAR, _EXCEED + "nanoseconds or feet, expected metres", 0.1),
    Rule("error", "difference", (SIZE > BOUND) & _FAR, _EXCEED + "centimetres or millimetres, or other anchors", 0.1),
    Rule("info", "gravity", _near(9.81), "measured gravity is {typical:.4g} m/s²"),
    Rule("warning", "free", _near(9.81), _TYPICAL + "m/s²: with gravity, but quaternion columns imply none"),
    *(Rule("error", "gravity", _near(size), _TYPICAL + f"m/s²: looks like {unit}, expected m/s² with gravity (9.81)")
      for unit, size in _GRAVITY_IN.items()),
    Rule("error", "gravity", _ODD & (SIZE.median() < 9.81 / 2), _TYPICAL + "m/s², expected 9.81: gravity looks "
         "subtracted; export the raw acceleration, or the attitude too, as qw, qx, qy, qz"),
    Rule("error", "gravity", _ODD & (SIZE.median() > 2 * 9.81), _TYPICAL + "m/s², expected 9.81: looks like another "
         "unit; `trackwright import` converts the common ones"),
    Rule("warning", "gravity", _ODD & SIZE.median().is_between(9.81 / 2, 2 * 9.81), _TYPICAL + "m/s², expected 9.81"),
)  # fmt: skip
"""What sizes of values say of their units; `bound`: of angles and rates, of a length in metres at this site."""

ANOMALIES = (
    Rule("warning", "rad phases", _BEYOND & _TURNED, _VALUES + "from 0 to 2π, not wrapped: trackers wrap them"),
    Rule("warning", "rad phases", _BEYOND & ~_TURNED, _VALUES + "degrees, or not wrapped"),
    Rule("warning", "quaternion", (X.abs() - 1).abs() > 0.01, "quaternions more than 1 % from unit length: {n}"),
    Rule("warning", "positive", X < 0.0, "negative values of {name}: {n}"),
)  # fmt: skip
ALONG = (
    Rule("warning", "t_s", (DT > 1) & (5 * DT.filter(DT > 0).median().over("stream") < DT) & (DT < JUMP_S),
         "gaps longer than 1 s: {n}, the longest {dt:.3g} s before {place}"),
    # Where many are wild, so are the neighbours of most.
    Rule("warning", " ".join(LEAST_JUMP), _MANY.fill_null(False) | _spike(1) | _spike(2)  # 2 finds two in a row
         | ((100 * SIZE.median().over("stream") < SIZE) & (SIZE > BOUND)),
         "outliers of {name}: {n}, the worst {x:.4g} at {place}"),
)  # fmt: skip
"""Of values along their streams; `bound`: the least jump."""


def broken(
    rules: Iterable[Rule], table: str, name: str, of: str, rows: pl.DataFrame, place: Place = str, site: str = ""
) -> Results:
    """The broken rules of the values `x`, of a nature, in rows with their `bound`; `place`: of a row, in words."""
    rows = rows.drop_nulls("x")
    for rule in rules if len(rows) else ():
        if of in rule.of.split() and len(found := rows.filter(rule.broken)) > rule.above * len(rows):
            worst = found.sort("dt" if of == "t_s" else SIZE).row(-1, named=True)
            facts = worst | {"n": len(found), "share": len(found) / len(rows), "typical": rows["x"].abs().median()}
            message = rule.sentence.format(**facts, site=site, name=name, place=place(worst))
            yield CheckResult(rule.level, table, message)


def check_units(rig: Rig, tables: Tables) -> Results:
    """Values and places of a size that suggests another unit, or another site."""
    knots = np.zeros((0, 2)) if rig.path_knots is None else np.asarray(rig.path_knots)
    names = [*(f"anchor {name}" for name in rig.anchors), *(f"station {name}" for name in rig.stations)]
    places = np.array([*(place[:2] for place in rig.places()), *knots]).reshape(-1, 2)
    across = float(np.linalg.norm(np.ptp(places, axis=0))) if len(places) > 1 else None
    far = np.abs(places - np.median(places, axis=0)).max(axis=1) > ELSEWHERE_M if len(places) > 1 else []
    for name in dict.fromkeys(np.array([*names, *["path_knots"] * len(knots)])[far].tolist()):
        yield CheckResult("error", "rig.toml", f"{name}: more than 100 km from the others; correct its coordinates")
    distances = [tables[name][kind.columns[0].name] for name, kind in KINDS.items() if name in tables and kind.distance]
    if len(rig.anchors) > 1 and distances and (typical := distances[0].abs().median()) is not None:
        at = np.stack(list(rig.anchors.values()))
        apart = float(np.median(np.sort(np.linalg.norm(at[:, None] - at, axis=-1), axis=1)[:, 1]))
        if apart >= max(100 * float(typical), FAR_M):  # type: ignore[arg-type]
            lengths = f"anchors {apart:,.5g} m apart, ranges of {float(typical):.3g} m"  # type: ignore[arg-type]
            yield CheckResult("error", "rig.toml", f"{lengths}: looks like millimetres, expected metres")
    site = "" if across is None else f", the rig is {significant(across, 3)} m across"
    length = FAR_M if across is None else 20 * max(across, 1.0)
    for table, rows in tables.items():
        for name, of, x, bound in _series(table_kinds()[table], rows, rig, length):
            yield from broken(UNITS, table, name, of, rows.select(x=x, bound=bound), site=site)


def _series(kind: Kind, rows: pl.DataFrame, rig: Rig, length: float) -> Iterator[tuple[str, str, pl.Expr, pl.Expr]]:
    """Name, nature, values and bound of what is judged together; `length`: that which is too long at this site."""
    norm = lambda *of: pl.sum_horizontal(C(*of) ** 2, ignore_nulls=False).sqrt()  # noqa: E731
    attitude, limit = {*QUATERNION} <= {*rows.columns}, pl.lit(length)
    if attitude:
        yield "quaternion", "quaternion", norm(*QUATERNION), limit
    if kind.numbered:
        columns = kind.layout(rows.columns).values
        yield kind.name, "phases", pl.concat_list(columns).explode(), pl.lit(math.pi)
    elif kind.position:
        x, y, _ = np.mean(rig.places() or [np.zeros(3)], axis=0)
        yield "distance from the rig", "place", ((C("x_m") - x) ** 2 + (C("y_m") - y) ** 2).sqrt(), limit
    elif kind.unit == "mps2":  # quaternions are the format's sign that gravity is subtracted
        yield "acceleration is", "free" if attitude else "gravity", norm("^accel_._mps2$"), limit
        yield "turn rates", "gyro", pl.concat_list("^gyro_._radps$").explode(), limit
    elif kind.difference:
        x = {name: [C(name).cast(pl.String).replace_strict({k: p[axis] for k, p in rig.anchors.items()}, default=None)
             for axis in range(3)] for name in kind.sensors}  # fmt: skip
        apart = pl.sum_horizontal((a - b) ** 2 for a, b in zip(*x.values(), strict=True)).sqrt()
        yield kind.columns[0].name, "difference", C(kind.columns[0].name), apart + kind.columns[0].bias
    else:
        for column in kind.columns:
            yield column.name, column.unit, C(column.name), limit if column.unit == "m" else pl.lit(column.bound)
            if column.positive:
                yield column.name, "positive", C(column.name), limit


def streams(table: pl.DataFrame, ids: Sequence[str]) -> pl.DataFrame:
    """The table sorted by stream, then time, with `stream` (its first row) and `dt`, s, null in its first row."""
    numbered = table.with_row_index("stream").with_columns(C("stream").first().over(ids))
    return numbered.sort("stream", "t_s", maintain_order=True).with_columns(dt=T.diff().over("stream"))


def with_value(table: pl.DataFrame, columns: Sequence[str]) -> pl.DataFrame:
    """The rows with any of the values."""
    return table.filter(pl.any_horizontal(C(*columns).is_not_null()))


def check_rows(rig: Rig, tables: Tables) -> Results:
    """What reading notices too: unknown tags, impossible values, clocks that jump, repeats, gaps and outliers."""
    zero, outliers = zero_of(first_time(tables)), list[CheckResult]()
    for name, table in tables.items():
        kind = table_kinds()[name]
        ids, values, *_ = kind.layout(table.columns)
        if unknown := [tag for tag in table["tag"].unique(maintain_order=True) if rig.tags and tag not in rig.tags]:
            named = f"{len(unknown)} ({listed(map(repr, unknown))})"
            yield CheckResult("warning", name, f"tags that are not in rig.toml: {named}")
        for label, of, x, bound in _series(kind, table, rig, FAR_M):
            yield from broken(ANOMALIES, name, label, of, table.select(x=x, bound=bound))
        yield from _jumps(name, table["t_s"].sort().to_numpy())
        rows = streams(with_value(table, values).select("t_s", *ids, *values), ids)
        repeated = rows.filter((DT == 0) | (DT.shift(-1) == 0))
        if exact := repeated.height - repeated.n_unique(["stream", "t_s", *values]):
            yield CheckResult("warning", *duplicates_line(name, exact).split(": ", 1))
        if again := repeated.height - repeated.n_unique(["stream", "t_s"]) - exact:
            few = "; the stamps have lost digits" if again > rows.height / 2 else ""
            what = f"rows with the time of another row of the same sensor and tag: {again}; kept{few}"
            yield CheckResult("warning", name, what)
        if name == "truth":
            continue
        # Which anchors a message has in common changes from one to the next.
        of_gaps = ids[:1] if kind.difference else ids
        along = streams(rows.drop("stream", "dt"), of_gaps) if kind.difference else rows
        yield from broken(ALONG, name, "t_s", "t_s", along.with_columns(x=T), _place(of_gaps, zero))
        for column in values:
            least, x = LEAST_JUMP.get(column.rpartition("_")[2], math.inf), C(column)
            if least < math.inf:  # angles are bounded
                seen = rows.drop_nulls(column).with_columns(
                    x=x, bound=least, steps=x.diff().abs().median().over("stream").fill_null(0.0),
                    away=(x - x.rolling_median(9, center=True)).abs().over("stream"),
                )  # fmt: skip
                outliers += broken(ALONG, name, column, column.rpartition("_")[2], seen, _place(ids, zero))
    yield from unobserved(rig, tables, "tag")
    yield from outliers


def _place(ids: Sequence[str], zero: float) -> Place:
    """The time, the tag and the sensors of a row."""
    return lambda row: f"{place_in_time(row['t_s'], zero)} ({', '.join(f'{column} {row[column]}' for column in ids)})"


def _jumps(name: str, times: np.ndarray) -> Results:
    """Clocks that jump by months or more, and times of 0 among others far away."""
    for k in np.flatnonzero(np.diff(times) > JUMP_S).tolist():
        before, after = times[k : k + 2].tolist()
        what = f"the clock jumps by {(after - before) / YEAR_S:.3g} years at row {k + 2} in order of time, from "
        what += f"{before:.10g} to {after:.10g} s: make two recordings"
        zeros = f"times of 0 in {k + 1} rows, the others from {after:.10g} s: missing; remove the rows"
        yield CheckResult("warning", name, zeros if times[0] == before == 0.0 else what)


def unobserved(rig: Rig, tables: Tables, *nouns: str) -> Results:
    """Anchors, stations or tags of the rig without a measurement: failed devices, or misspelt ids."""
    for noun in nouns:
        known, seen = {"anchor": rig.anchors, "station": rig.stations, "tag": rig.tags}[noun], set[str]()
        for name, table in tables.items():
            ids, values, *_ = table_kinds()[name].layout(table.columns)
            for column in ids if name != "truth" else ():
                seen |= set(with_value(table, values)[column].unique()) if column.startswith(noun) else set()
        silent = [repr(key) if noun == "tag" else key for key in known if key not in seen]
        # A folder of fixes may have anchors that no table names.
        if silent and (seen or noun == "station"):
            what = f"{noun}s never observed: {len(silent)} of {len(known)} ({listed(silent, 8)})"
            yield CheckResult("warning", "rig.toml", what)


def check_rates(tables: Tables) -> Results:
    """The share of empty cells; rows and rate of each stream, or of each table if it has many."""
    for name, table in tables.items():
        ids, values, *_ = table_kinds()[name].layout(table.columns)
        present = with_value(table, values)
        if present.is_empty():
            yield CheckResult("warning" if name == "truth" else "error", name, "all values are missing")
            continue
        empty = [f"{c} {100 * n / table.height:.3g} %" for c in values if (n := table[c].null_count())]
        yield from [CheckResult("info", name, f"empty cells: {', '.join(empty)}")] if empty else []
        rate = 1 / DT.filter(DT > 0).median()
        along = streams(present.select("t_s", *ids), ids)
        found = along.group_by("stream", *ids, maintain_order=True).agg(n=pl.len(), rate=rate)
        if len(found) > STREAMS_SHOWN:
            whole = ", ".join(counted(found[column].n_unique(), column) for column in ids)
            found = found.select(n=C("n").sum(), rate=C("rate").median())
        for row in found.iter_rows(named=True):
            of = ", ".join(f"{column} {row[column]}" for column in reversed(ids)) if "tag" in row else whole
            hertz = f", {row['rate']:.3g} Hz" if row["rate"] else ""
            yield CheckResult("info", name, f"{of}: {counted(row['n'], 'row')}{hertz}")


def check_times(tables: Tables, base: bool = True) -> Results:
    """Errors and warnings of the unit of times; of the `base`, warnings of a late start, and the span of all tables."""
    first, last = _ends(tables)
    steps = [table["t_s"].unique().diff().median() for table in tables.values()]
    shortest = min((float(step) for step in steps if isinstance(step, float)), default=0.0)
    units = ((1e17, "nanoseconds"), (1e14, "microseconds"), (1e11, "milliseconds"), (1e8, "seconds"))
    unit = next((unit for least, unit in units if first > least), "")
    if unit and (base or unit != "seconds"):
        message = f"starts at {first:.0f}: looks like {unit} since 1970, expected seconds since the start of recording"
        fix = "; `trackwright import` subtracts it, as t_s=stamp-1777904000" * (unit == "seconds")
        yield CheckResult("warning" if fix else "error", "t_s", message + fix)
    if shortest >= 5 and last - first > 1000 and unit in ("", "seconds"):
        message = f"rows {shortest:.4g} s apart over {last - first:.6g} s: looks like milliseconds, expected seconds"
        yield CheckResult("warning", "t_s", message)
    if base and not unit:
        late = abs(first) > 60.0
        message = f"starts at {moment(first)}, expected a start near 0" if late else f"from {span(first, last)}"
        yield CheckResult("warning" if late else "info", "t_s", message)


def _ends(tables: Tables) -> tuple[float, float]:
    times = pl.concat([table["t_s"] for table in tables.values()])
    return float(times.min()), float(times.max())  # type: ignore[arg-type]


def check_clocks(tables: Tables) -> Results:
    """Errors: tables far in time from the first one of a tag, and streams whose rows all have one time."""
    firsts = dict[str, tuple[str, float, float]]()
    for name, table in ((name, tables[name]) for name in table_kinds() if name in tables):
        ids = table_kinds()[name].layout(table.columns).ids
        same = table.group_by(ids).agg(rows=pl.len(), times=T.n_unique()).filter(C("times") == 1)
        if stuck := same.filter(C("rows") >= LEAST_STAMPS)["rows"].sum():
            message = f"{stuck} rows have one time per sensor and tag: the stamps have lost their digits"
            yield CheckResult("error", name, f"{message}; export them again with fractions of a second")
        ends = table.group_by("tag", maintain_order=True).agg(T.min().alias("start"), T.max().alias("end"))
        for tag, start, end in ends.iter_rows() if name != "truth" else ():
            one, first, last = firsts.setdefault(tag, (name, start, end))
            # One sensor may be switched on after another was switched off.
            if max(start - last, first - end) > max(10.0 * (last - first + end - start), 600.0):
                message = f"tag {tag}: {span(start, end)}, and {one} {span(first, last)}{_two_clocks(start - first)}"
                yield CheckResult("error", name, message)
                break


def _two_clocks(apart: float) -> str:
    """The likely cause of tables that begin so many seconds apart, and what is expected."""
    half_hours, cause = apart / 1800, ""
    if abs(apart) > 1e8:
        cause = "; one of them counts from 1970, the other from its own zero"
    elif abs(half_hours) > 0.8 and abs(half_hours - round(half_hours)) < 0.05:
        cause = f"; {half_hours / 2:.3g} hours apart, as two time zones"
    return f"{cause}; expected one clock for all tables"


def check_cover(truth: pl.DataFrame, measured: Tables, full: bool) -> Results:
    """An error for a truth of another time; in `full` its holes, and the share of the measurements that it covers."""
    (first, last), (start, end) = _ends({"truth": truth}), _ends(measured)
    known = truth.select("t_s", "tag", "x_m", "y_m", "z_m").drop_nulls()
    share = float(first <= end and last >= start)
    if full:
        rows = TableRows(pl.concat([table.select("t_s", "tag") for table in measured.values()]))
        status = TruePaths.of_table(known, "").at(rows.tags, rows.starts, rows.times)[1]
        share = float(np.mean(status == TruthStatus.SCORED))
        moved = pl.sum_horizontal(C(axis).diff() ** 2 for axis in ("x_m", "y_m", "z_m")).sqrt()
        steps = streams(known, ["tag"]).with_columns(t_s=T.shift(), moved=moved)
        holes = steps.filter((DT > HOLE_S) & (C("moved") > HOLE_M)).sort("dt")
        if len(holes):
            place = _place(["tag"], zero_of(first_time(measured)))(holes.row(-1, named=True))
            message = f"holes longer than {HOLE_S:g} s with motion: {len(holes)}, the longest {holes['dt'][-1]:.3g} s "
            yield CheckResult("warning", "truth", f"{message}after {place}; estimates inside are not scored")
        if without := sorted({*rows.tags} - {*known["tag"]}):
            message = f"measured tags without truth: {len(without)} ({listed(without, 8)})"
            yield CheckResult("info", "truth", message)
    if not share:
        message = f"no measurement lies inside the time span of the truth, {span(first, last)}; the measurements begin "
        yield CheckResult("error", "truth", f"{message}at {moment(start)}{_two_clocks(first - start)}")
    elif full:
        message = f"covers {100 * share:.3g} % of the measurements in time"
        yield CheckResult("info" if share >= 0.5 else "warning", "truth", message)


def check_heights(rig: Rig, tables: Tables) -> Results:
    """An error for each tag of known height that truth or ranges contradict."""
    heights = {tag: known.height for tag, known in rig.tags.items() if known.height is not None}
    up = {key: float(place[2]) for key, place in rig.anchors.items()}
    height, contrary = C("tag").replace_strict(heights, default=None, return_dtype=pl.Float64), dict[str, str]()
    for name, kind in KINDS.items() if heights else ():
        if name in tables and kind.distance:
            short = C(kind.columns[0].name) < (C(kind.noun).replace_strict(up, default=None) - height).abs() - OFF_M
            for tag, share in tables[name].group_by("tag", maintain_order=True).agg(short.mean()).iter_rows():
                if (share or 0.0) > 0.5:
                    contrary[tag] = (
                        f"{share:.0%} of its {name} are shorter than the difference of height to their anchors"
                    )
    truth = tables["truth"].group_by("tag", maintain_order=True).agg(C("z_m").median()) if "truth" in tables else None
    for tag, z in () if truth is None else truth.iter_rows():
        if z is not None and tag in heights and abs(z - heights[tag]) > OFF_M:
            fix = "height_m has the wrong sign" if z > 0 else "z of the truth points down; flip its sign"
            fix = fix if abs(z + heights[tag]) <= OFF_M else "one of the two is wrong"
            contrary[tag] = f"z of its truth is typically {z:.2f} m: {fix}"
    for tag, why in contrary.items():
        yield CheckResult("error", "rig.toml", f"height_m of tag {tag} is {heights[tag]:g}, but {why}")


def check_offsets(rig: Rig, paths: TruePaths) -> Results:
    """An error for an `offset_m` too long for a body, and for the first two tags of each that truth has elsewhere."""
    offsets = {tag: np.asarray(known.offset, float) for tag, known in rig.tags.items() if known.offset is not None}
    for tag in (tag for tag, offset in offsets.items() if np.linalg.norm(offset) > 20.0):
        message = f"offset_m of tag {tag} is {np.linalg.norm(offsets[tag]):.4g} m long: looks like millimetres or "
        yield CheckResult("error", "rig.toml", f"{message}centimetres, expected metres")
        return
    for body in dict.fromkeys(map(rig.on_body_of, offsets)):
        for one, other in combinations([tag for tag in body if tag in paths.number], 2):
            at = paths.of_tag(one)[0]
            at = at[:: -(-len(at) // POINTS)]
            true = [paths.at([tag], np.array([0, len(at)]), at)[0] for tag in (one, other)]
            distances = np.linalg.norm(true[0] - true[1], axis=1)
            apart = float(np.median(distances[np.isfinite(distances)])) if np.isfinite(distances).any() else math.nan
            given = float(np.linalg.norm(offsets[one] - offsets[other]))
            if abs(apart - given) > OFFSET_M * max(1.0, given, apart):
                both = f"{one} and {other} are {given:.2f} m apart, their true positions typically {apart:.2f} m"
                fix = "correct them, or list the tags of each body under [bodies]"
                yield CheckResult("error", "rig.toml", f"offset_m of tags {both}; {fix}")
                break
