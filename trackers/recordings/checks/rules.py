"""What tables and the rig alone tell, by rules and short functions; a stream is the rows of one sensor and one tag."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, NamedTuple, get_args

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UNIX_S, listed, significant, span
from trackwright.trackers.core.model.rig import SAY_SIDE, THIN, Rig
from trackwright.trackers.recordings.columns import QUATERNION
from trackwright.trackers.recordings.kinds import KINDS, Kind, table_kinds

Level = Literal["error", "warning", "info"]
LEVELS: tuple[Level, ...] = get_args(Level)
Tables = Mapping[str, pl.DataFrame]
C, DT, T, X, SIZE, BOUND = pl.col, pl.col("dt"), pl.col("t_s"), pl.col("x"), pl.col("x").abs(), pl.col("bound")
# A step that is a jump of the clock and no gap, a year, s; reach of indoor radio, m; by how much heights are off by a
# mistake, m; rows that cannot all have one time.
JUMP_S, YEAR_S, FAR_M, OFF_M, LEAST_STAMPS = 1e7, 31_557_600.0, 500.0, 0.5, 10
# Least jumps of outliers by unit, speed of a tag between two readings, m/s, and sizes of gravity.
FAST_MPS, LEAST_JUMP = 3.0, {"m": 1.0, "mps": 10.0, "mps2": 40.0, "radps": 10.0}
GRAVITY_IN = {9.81: "m/s²", 1.0: "multiples of g", 32.2: "ft/s²", 1e3: "thousandths of g or cm/s²", 9.81e3: "mm/s²"}


@dataclass(frozen=True)
class CheckResult:
    """One result, of a table, file or column: an `error` makes tracks fail or wrong, a `warning` is an anomaly."""

    level: Level
    where: str
    message: str


Results = Iterator[CheckResult]


class Rule(NamedTuple):
    """A line where more than a share `above` of the values of a nature `of` is `broken`."""

    level: Level
    of: str
    broken: pl.Expr
    sentence: str
    above: float = 0.0


def _near(size: float) -> pl.Expr:
    return (SIZE.median() - size).abs() <= 0.15 * size


_BEYOND, _TYPICAL = SIZE > BOUND + 1e-3, "typical {name} {typical:,.4g} "  # with room for π rounded up in text
_TURN, _LIES = 2 * math.pi, "{share:.0%} of {name} lie beyond ±{bound:.3g}: looks like "
_TURNED = (X.is_between(-1e-3, _TURN + 1e-3) & (((X + _TURN / 2) % _TURN - _TURN / 2).abs() <= BOUND + 1e-3)).all()
_LONG, _UPRIGHT = SIZE.median() > BOUND, X.is_between(0.0, math.pi).all()

UNITS = (
    Rule("error", "phases", SIZE.median() > _TURN, _TYPICAL + "rad: looks like degrees, expected (-π, π]"),
    Rule("error", "gyro", SIZE.quantile(0.95) > 35.0,  # the full scale of common gyroscopes
         "turn rates beyond 35 rad/s: looks like degrees per second, expected radians"),
    Rule("error", "rad", _BEYOND & ~_TURNED & ~_UPRIGHT, _LIES + "degrees, expected radians", 0.1),
    Rule("error", "rad", _BEYOND & ~_TURNED & _UPRIGHT, _LIES + "angles from the vertical, expected elevations: map "
         "90 less them, in deg", 0.1),
    Rule("error", "radps mps", _BEYOND, _LIES + "degrees, or millimetres or centimetres, per second", 0.1),
    Rule("error", "place m", _LONG, _TYPICAL + "m{site}: looks like centimetres, millimetres or another frame"),
    # A signal takes 1e-6 s for 300 m; in metres some values exceed their resolution.
    Rule("error", "m", SIZE.max() < 1e-5, "{name} below 1e-5 m: looks like seconds, expected metres"),
    *(Rule("info" if size == 9.81 else "error", "gravity", _near(size), _TYPICAL + f"m/s²: gravity in {unit}, expected "
           "m/s²") for size, unit in GRAVITY_IN.items()),
    Rule("error", "gravity", ~pl.any_horizontal(*map(_near, GRAVITY_IN)), _TYPICAL + "m/s², expected 9.81: another "
         "unit, or gravity looks subtracted; export the raw acceleration, or the attitude too, as qw, qx, qy, qz"),
)  # fmt: skip
"""What sizes of values say of their units; `bound`: of angles and rates, of a length in metres at this site."""

ANOMALIES = (
    Rule("warning", "rad phases", _BEYOND & _TURNED, "{name} beyond ±{bound:.3g}: {n}; from 0 to 2π, not wrapped"),
    Rule("warning", "rad phases", _BEYOND & ~_TURNED, "{name} beyond ±{bound:.3g}: {n}; degrees, or not wrapped"),
    Rule("warning", "positive", X < 0.0, "negative values of {name}: {n}"),
    Rule("warning", "t_s", (DT > 1) & (5 * DT.filter(DT > 0).median().over("stream") < DT) & (DT < JUMP_S),
         "gaps longer than 1 s: {n}, the longest {dt:.3g} s before {place}"),
    # Also where many are wild, and so are the neighbours of most.
    Rule("warning", " ".join(LEAST_JUMP), C("away") > (14.826 * C("away").median().over("stream")).clip(BOUND),
         "outliers of {name}: {n}, the worst {x:.4g} at {place}"),
    Rule("warning", "step", (X > 1.0) & (X > 30.0 * DT),
         "jumps of the truth beyond 1 m and 30 m/s: {n}, the worst {x:.3g} m at {place}; not seen there? leave it out"),
)  # fmt: skip
"""Three of values by themselves, then along streams: `bound` is the least jump, `away` the distance from neighbours."""


def broken(rules: Iterable[Rule], table: str, name: str, of: str, rows: pl.DataFrame, site: str = "") -> Results:
    """The broken rules of the values `x`, of a nature, in rows with their `bound`."""
    rows = rows.drop_nulls("x")
    for rule in rules if len(rows) else ():
        if of in rule.of.split() and len(found := rows.filter(rule.broken)) > rule.above * len(rows):
            worst = found.sort("dt" if of == "t_s" else SIZE).row(-1, named=True)
            sensors = ", ".join(f"{c} {worst[c]}" for c in worst if c.startswith(("tag", "anchor", "station")))
            numbers = {"n": len(found), "share": len(found) / len(rows), "typical": rows["x"].abs().median()}
            place = f"t_s {worst.get('t_s', 0.0):.3f} ({sensors})"
            message = rule.sentence.format(**worst | numbers, name=name, site=site, place=place)
            yield CheckResult(rule.level, table, message)


def check_units(rig: Rig, tables: Tables) -> Results:
    """Values and places of a size that suggests another unit, or another site."""
    named = {**rig.anchors, **{name: station.position for name, station in rig.stations.items()}}
    knots = np.zeros((0, 2)) if rig.path_knots is None else rig.path_knots
    places = np.array([*(place[:2] for place in named.values()), *knots]).reshape(-1, 2)
    away = np.linalg.norm(places - np.median(places, axis=0), axis=1) if len(places) > 2 else np.zeros(0)
    if far := [name for name, one in zip(named, away, strict=False) if one > max(FAR_M, 20 * np.median(away))]:
        yield CheckResult("error", "rig.toml", f"{listed(far)}: far from all others; correct the coordinates")
    across = float(np.linalg.norm(np.ptp(places, axis=0))) if len(places) > 1 else None
    at = np.reshape([*rig.anchors.values()], (-1, 3))
    typical = tables["ranges"]["range_m"].abs().median() if "ranges" in tables and len(at) > 1 else None
    if isinstance(typical, float) and math.isfinite(typical):
        apart = float(np.median(np.sort(np.linalg.norm(at[:, None] - at, axis=-1), axis=1)[:, 1]))
        if apart >= max(100 * typical, FAR_M):
            lengths = f"anchors {apart:,.5g} m apart, ranges of {typical:.3g} m"
            yield CheckResult("error", "rig.toml", f"{lengths}: looks like millimetres, expected metres")
    site = "" if across is None else f", the rig is {significant(across, 3)} m across"
    for table, rows in tables.items():
        for name, of, x, bound in _series(table_kinds()[table], rows, rig, 20 * max(across or FAR_M / 20, 1.0)):
            yield from broken(UNITS, table, name, of, rows.select(x=x, bound=bound), site)


def _series(kind: Kind, rows: pl.DataFrame, rig: Rig, length: float) -> Iterator[tuple[str, str, pl.Expr, pl.Expr]]:
    """Name, nature, values and bound of what is judged together; `length`: what is too long at this site."""
    attitude, limit = {*QUATERNION} <= {*rows.columns}, pl.lit(length)
    if kind.numbered:
        yield kind.name, "phases", pl.concat_list(kind.layout(rows.columns).values).explode(), pl.lit(math.pi)
    elif kind.position:
        x, y, _ = np.mean(rig.places() or [np.zeros(3)], axis=0)
        yield "distance from the rig", "place", ((C("x_m") - x) ** 2 + (C("y_m") - y) ** 2).sqrt(), limit
    elif kind.unit == "mps2":  # quaternions are the format's sign that gravity is subtracted
        force = pl.sum_horizontal(C("^accel_._mps2$") ** 2, ignore_nulls=False).sqrt()
        yield "acceleration is", "" if attitude else "gravity", force, limit
        yield "turn rates", "gyro", pl.concat_list("^gyro_._radps$").explode(), limit
    else:
        for column in kind.columns:
            yield column.name, column.unit, C(column.name), limit if column.unit == "m" else pl.lit(column.bound)
            if column.positive:
                yield column.name, "positive", C(column.name), limit


def streams(table: pl.DataFrame, ids: Sequence[str]) -> pl.DataFrame:
    """The table sorted by stream, then time, with `stream` (its first row) and `dt`, s, null in its first row."""
    numbered = table.with_row_index("stream").with_columns(C("stream").first().over(ids))
    return numbered.sort("stream", "t_s", maintain_order=True).with_columns(dt=T.diff().over("stream"))


def check_rows(rig: Rig, tables: Tables) -> Results:
    """What reading notices too: unknown tags, impossible values, clocks that jump, repeats, gaps and outliers."""
    for name, table in tables.items():
        kind = table_kinds()[name]
        ids, values, *_ = kind.layout(table.columns)
        if unknown := [tag for tag in table["tag"].unique(maintain_order=True) if rig.tags and tag not in rig.tags]:
            what = f"tags that are not in rig.toml: {len(unknown)} ({listed(map(repr, unknown))})"
            yield CheckResult("warning", name, what)
        for label, of, x, bound in _series(kind, table, rig, FAR_M):
            yield from broken(ANOMALIES[:3], name, label, of, table.select(x=x, bound=bound))
        times = table["t_s"].sort().to_numpy()
        jumps = np.flatnonzero(np.diff(times) > JUMP_S).tolist()
        # Where most steps are as long, the unit of times is another.
        for k in jumps[: 2 * len(jumps) <= len({*times.tolist()})]:
            before, after = times[k : k + 2].tolist()
            what = f"the clock jumps by {(after - before) / YEAR_S:.3g} years at row {k + 2} in order of time, from "
            several = f", the first of {len(jumps)} jumps" * (len(jumps) > 1)
            what += f"{before:.10g} to {after:.10g} s{several}: make two recordings"
            zeros = f"times of 0 in {k + 1} rows, the others from {after:.10g} s: missing; remove the rows"
            yield CheckResult("warning", name, zeros if times[0] == before == 0.0 else what)
        rows = streams(table.filter(pl.any_horizontal(C(*values).is_not_null())).select("t_s", *ids, *values), ids)
        repeated = rows.filter((DT == 0) | (DT.shift(-1) == 0))
        if exact := repeated.height - repeated.n_unique(["stream", "t_s", *values]):
            yield CheckResult("warning", name, f"duplicate rows: {exact}; counted once")
        if again := repeated.height - repeated.n_unique(["stream", "t_s"]) - exact:
            what = f"rows with the time of another row of the same sensor and tag: {again}; kept"
            why = "; the stamps have lost digits" if 2 * again > rows.height else "; the rows of several tags as one?"
            yield CheckResult("warning", name, what + why * (again > rows.height / 10))
        # Which anchors a message has in common changes from one to the next.
        along = streams(rows.drop("stream", "dt"), ids[:1]) if kind.difference else rows
        yield from broken(ANOMALIES[3:], name, "t_s", "t_s", along.with_columns(x=T)) if name != "truth" else ()
        if name == "truth":
            step = (C("x_m").diff() ** 2 + C("y_m").diff() ** 2).sqrt().over("stream")
            yield from broken(ANOMALIES[3:], name, "truth", "step", rows.with_columns(x=step, bound=0.0))
        for column in values if name != "truth" else ():
            unit, x = column.rpartition("_")[2], C(column)
            away = (x - x.rolling_median(5, center=True, min_samples=3)).abs().over("stream")
            least = LEAST_JUMP.get(unit, math.inf) + FAST_MPS * DT.median() * (unit == "m")
            seen = rows.drop_nulls(column).with_columns(x=x, away=away, bound=least)
            yield from broken(ANOMALIES[3:], name, column, unit, seen)  # angles are bounded
    yield from unobserved(rig, tables, "tag")


def _seen(tables: Tables, noun: str) -> set[str]:
    """The ids of the anchors, stations or tags with measurements."""
    columns = (table[c] for name, table in tables.items() if name != "truth" for c in (noun, f"{noun}_2") if c in table)
    return {key for column in columns for key in column.unique()}


def unobserved(rig: Rig, tables: Tables, *nouns: str) -> Results:
    """Anchors, stations or tags of the rig without a measurement: failed devices, or misspelt ids."""
    for noun in nouns:
        known, seen = {"anchor": rig.anchors, "station": rig.stations, "tag": rig.tags}[noun], _seen(tables, noun)
        silent = [repr(key) if noun == "tag" else key for key in known if key not in seen]
        # A folder of fixes may have anchors that no table names.
        if silent and (seen or noun == "station"):
            what = f"{noun}s never observed: {len(silent)} of {len(known)} ({listed(silent, 8)})"
            yield CheckResult("warning", "rig.toml", what)


def check_rates(tables: Tables) -> Results:
    """Rows, the typical rate of a stream and the share of empty cells of each table."""
    for name, table in tables.items():
        ids, values, *_ = table_kinds()[name].layout(table.columns)
        rate = streams(table.select("t_s", *ids), ids).filter(DT > 0).select(1 / DT.median()).item() or 0.0
        empty = {c: table[c].null_count() / table.height for c in values}
        what = "".join(f", {c} {100 * share:.3g} % empty" for c, share in empty.items() if share)
        lost = name != "truth" and min(empty.values()) == 1.0
        yield CheckResult("error" if lost else "info", name, f"{table.height} rows, {rate:.3g} Hz{what}")


def check_times(tables: Tables, base: bool = True) -> Results:
    """Errors and warnings of the unit of times; of the `base`, warnings of a late start, and the span of all tables."""
    first, last = _ends(*tables.values())
    units = ((1e17, "nanoseconds"), (1e14, "microseconds"), (1e11, "milliseconds"))
    unit = next((unit for least, unit in units if first > least), "")
    steps = [float(step) for table in tables.values() if (step := table["t_s"].unique().diff().median()) is not None]  # type: ignore[arg-type]
    if unit:
        yield CheckResult("error", "t_s", f"starts at {first:.0f}: looks like {unit} since 1970, expected seconds")
    elif steps and min(steps) >= 5 and last - first > 1000:
        unit = next((unit for least, unit in units if min(steps) >= 1e-10 * least), "milliseconds")
        message = f"rows {min(steps):.4g} s apart over {last - first:.6g} s: looks like {unit}, expected seconds"
        yield CheckResult("warning", "t_s", message)
    elif base:
        late = ", expected a start near 0, or seconds since 1970" * (abs(first) > 60.0 and first < UNIX_S)
        yield CheckResult("warning" if late else "info", "t_s", f"from {span(first, last)}{late}")


def _ends(*tables: pl.DataFrame) -> tuple[float, float]:
    times = pl.concat([table["t_s"] for table in tables])
    return float(times.min()), float(times.max())  # type: ignore[arg-type]


def check_clocks(measured: Tables, truth: pl.DataFrame | None) -> Results:
    """Errors: streams whose rows all have one time, tables far in time from the first, in another unit or elsewhere."""
    clocks = "as two time zones, or clocks of different zeros; expected one: add the difference to t_s of one by import"
    one, (first, last) = next(iter(measured)), _ends(next(iter(measured.values())))
    for name, table in (measured if truth is None else {**measured, "truth": truth}).items():
        of_stream = table.group_by(table_kinds()[name].layout(table.columns).ids).agg(n=pl.len(), times=T.n_unique())
        if stuck := of_stream.filter((C("times") == 1) & (C("n") >= LEAST_STAMPS))["n"].sum():
            message = f"{stuck} rows have one time per sensor and tag: the stamps have lost their digits"
            yield CheckResult("error", name, f"{message}; export them again with fractions of a second")
        (start, end), within = _ends(table), int(table["t_s"].is_between(first, last).sum())
        many = min(table.height, measured[one].height) > 10 * LEAST_STAMPS
        if many and within <= LEAST_STAMPS and end - start > 20.0 * (last - first) > 0.0:
            message = f"{span(start, end)}, and {one} {span(first, last)}, in which {within} of {table.height} rows lie"
            yield CheckResult("error", name, f"{message}: looks like another unit of time, expected seconds")
        # One sensor may be switched on after another was switched off.
        elif max(start - last, first - end) > max(10.0 * (last - first + end - start), 600.0) and name != "truth":
            message = f"{span(start, end)}, and {one} {span(first, last)}; {(start - first) / 3600:.4g} hours apart"
            yield CheckResult("error", name, f"{message}, {clocks}")
    if truth is not None:
        spans = truth.group_by("tag").agg(start=T.min(), end=T.max())
        rows = pl.concat([table.select("t_s", "tag") for table in measured.values()]).join(spans, "tag", "left")
        share = float(rows.select(T.is_between("start", "end").fill_null(False).mean()).item())
        apart = f" ({span(*_ends(truth))}, and they {span(*_ends(*measured.values()))}: {clocks})" if not share else ""
        level: Level = "info" if share >= 0.5 else "warning" if share else "error"
        yield CheckResult(level, "truth", f"covers {100 * share:.3g} % of the measurements in time{apart}")


def check_heights(rig: Rig, truth: pl.DataFrame) -> Results:
    """An error for each tag of known height that its truth contradicts, and for anchors below 0 with a truth above."""
    highest = max((place[2] for place in rig.anchors.values()), default=0.0)
    if highest < 0.0 < (truth["z_m"].median() or 0.0):  # type: ignore[operator]
        yield CheckResult("error", "rig.toml", "z of all anchors is negative, of the truth positive: one points down")
    known = {tag: of.height for tag, of in rig.tags.items() if of.height is not None}
    for tag, z in truth.group_by("tag", maintain_order=True).agg(C("z_m").median()).drop_nulls().iter_rows():
        if abs(z - known.get(tag, z)) > OFF_M:
            message = f"height_m of tag {tag} is {known[tag]:g}, but z of its truth is typically {z:.2f} m"
            yield CheckResult("error", "rig.toml", f"{message}: one of the two is wrong, or points down")


def check_geometry(rig: Rig, tables: Tables) -> Results:
    """What the places of the sensors that are observed leave undetermined."""
    known = bool(rig.tags) and all(tag.height is not None for tag in rig.tags.values())
    kinds = [KINDS[name] for name in tables]
    for noun in ("anchor", "station"):
        of = next((kind for kind in (*kinds, KINDS["ranges"]) if kind.noun == noun), KINDS["bearings"])
        fixes = noun == "anchor" and "fixes" in tables and of not in kinds
        used = {key: place for key, place in of.places(rig).items() if fixes or key in _seen(tables, noun)}
        for one, other in combinations(used, 2):
            if np.linalg.norm(used[one] - used[other]) < 1e-3:
                yield CheckResult("warning", "rig.toml", f"{one} and {other} have the same position; correct one")
        least = 2 if noun == "station" else 3 + (2 - known) * of.difference
        # A distance and a direction are a position, each alone is none.
        if 0 < len(used) < least and not fixes and sum(bool(kind.sensors) or kind.position for kind in kinds) == 1:
            message = f"{noun}s observed: {len(used)}, expected {least} or more for a position"
            yield CheckResult("warning" if noun == "anchor" else "info", "rig.toml", message)
        elif len(used) > 2:
            _, sizes, axes = np.linalg.svd(np.stack([*used.values()]) - np.mean([*used.values()], axis=0))
            dimension, level = int((sizes > THIN * max(sizes[0], 1e-6)).sum()), abs(axes[2, 2]) > 0.7
            side = "the height of the tags is known" if known else SAY_SIDE
            what = f"coplanar: the height is weakly determined and may be mirrored at their plane ({side})"
            what = what if level else "coplanar in a vertical plane: positions may be mirrored at it"
            what = what if dimension == 2 else "collinear: positions around their line cannot be told apart"
            if dimension < (3 if noun == "anchor" else 2):
                good = known and level and dimension == 2
                yield CheckResult("info" if good else "warning", "rig.toml", f"the {noun}s are {what}")


def without_height(rig: Rig, table: pl.DataFrame, seen: str = "x_m", height: str = "z_m") -> list[str]:
    """The tags of a table with values in a column `seen`, but none of `height`, and without a known height."""
    some = table.group_by("tag", maintain_order=True).agg(C(seen, height).is_not_null().any())
    lacking = some.filter(C(seen) & ~C(height))["tag"]
    return [tag for tag in lacking if tag not in rig.tags or rig.tags[tag].height is None]
