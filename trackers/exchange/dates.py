"""Dates and times of day in columns of text as seconds: the order of day, month and year is stated, never guessed."""

from __future__ import annotations

import re

import polars as pl

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.table_file import TableFile, first_row

ISO, DOTTED = "yyyy-mm-dd", "dd.mm.yyyy"
ORDERS = {"iso": ISO, **{o: o for m in "/.-" for o in (f"dd{m}mm{m}yyyy", f"mm{m}dd{m}yyyy", f"yyyy{m}mm{m}dd")}}
ORDERS["dd-mmm-yyyy"] = "dd-mmm-yyyy"
"""The orders of dates by the name that `t_s=COLUMN in NAME` has."""

CLOCK, DAYS = "hh:mm:ss", {"matlab": 719529.0, "excel": 25569.0}
"""The name of times of day; the names of counts of days, with the count at the begin of 1970."""

CLOCK_TEXT = r"^(\d\d?):(\d\d)(?::(\d\d(?:[.,]\d*)?))?$"
_NAMES = "jan feb mar apr may jun jul aug sep oct nov dec"
_MONTHS = {name: f"{k:02d}" for k, name in enumerate(_NAMES.split(), 1)}
_PARTS = {"mmm": r"(?P<m>[A-Za-z]{3})", "yyyy": r"(?P<y>\d{4})", "mm": r"(?P<m>\d{1,2})", "dd": r"(?P<d>\d{1,2})"}
_SECONDS = r"(?::(?P<S>\d\d)(?:[.,](?P<f>\d{1,9})\d*)?)?"
_TIME = rf"(?:[T ]+(?P<H>\d\d?):(?P<M>\d\d){_SECONDS}\s*(?P<z>Z|[+-]\d\d:?(?:\d\d)?)?)?"


def order_in(dates: pl.Series, order: str) -> str:
    """The order of the dates in a column: dotted ones, unknown to ISO, are day, month, year everywhere."""
    first = str(next(iter(dates), "")).strip()
    return DOTTED if order == ISO and re.match(r"\d{1,2}\.\d{1,2}\.\d{4}\b", first) else order


def clock_seconds(texts: pl.Series) -> pl.Series:
    """Times of day, s, which go on after midnight; null for another text."""
    parts = texts.cast(pl.String).str.strip_chars().str.extract_groups(CLOCK_TEXT)
    h, m, s = (part.str.replace(",", ".").cast(pl.Float64) for part in parts.struct.unnest())
    seconds = h * 3600 + m * 60 + s.fill_null(0.0)
    return seconds + 86400.0 * (seconds.forward_fill().diff() < -43200.0).fill_null(False).cum_sum()


def date_seconds(texts: pl.Series, order: str) -> tuple[pl.Series, pl.Series]:
    """Dates as seconds since 1970, null for another text, and whether each names no time zone, which is then UTC."""
    if texts.dtype in (pl.Datetime, pl.Date):
        dates, local = texts, texts.is_null()
    else:
        pattern = re.sub("yyyy|mmm|mm|dd", lambda match: _PARTS[match[0]], re.escape(order_in(texts, order)))
        parts = texts.cast(pl.String).str.strip_chars().str.extract_groups(f"^{pattern}{_TIME}$").struct.unnest()
        parts = parts.with_columns(pl.col("m").str.to_lowercase().replace(_MONTHS))
        time, zone = (pl.col(x).fill_null("00") for x in "HMSf"), pl.col("z").replace("Z", "+00").fill_null("+00")
        date = pl.format("{}-{}-{} {}:{}:{}.{} {}", "y", "m", "d", *time, zone)
        dates = parts.select(date.str.to_datetime("%Y-%m-%d %H:%M:%S%.f %#z", time_unit="ns", strict=False))["y"]
        local = parts["z"].is_null()
    whole = dates.dt.epoch("ns")
    # The seconds are exact; only their sum with the fraction is rounded.
    return (whole // 1_000_000_000).cast(pl.Float64) + (whole % 1_000_000_000).cast(pl.Float64) / 1e9, local


def moments_of(file: TableFile, texts: pl.Series, column: str, order: str) -> pl.Series:
    """Times of day or dates of an order as seconds, null where empty; raises UnusableInput with the row of others."""
    full = texts.is_not_null() & (texts.cast(pl.String).str.strip_chars() != "")
    if order == CLOCK:
        found, local = clock_seconds(texts), pl.repeat(True, len(texts), eager=True)
    else:
        found, local = date_seconds(texts, order)
    wrong = full & (found.is_null() | (local != next(iter(local.filter(full)), True)))
    if not wrong.any():
        return found
    row, order = first_row(wrong), order_in(texts, order)
    text, mark = str(texts[row]), "-" if "-" in str(texts[row]) else "/"
    example = order.replace("yyyy", "2026").replace("mmm", "May").replace("mm", "05").replace("dd", "31")
    fix = f"name it, as 't_s={column} in mm{mark}dd{mark}yyyy' or 't_s={column} in dd{mark}mm{mark}yyyy'"
    if re.search("-[A-Za-z]{3}-", text):
        fix = f"name it: 't_s={column} in dd-mmm-yyyy'"
    expected = f"a date such as {example} 14:00:00.25; no order is guessed: {fix}"
    if order == CLOCK:
        expected = "a time of day such as 14:00:00.25"
    elif found[row] is not None:
        first = first_row(full)
        expected = f"as in row {first + 1}, {texts[first]!r}, a time zone in every row, or in none"
    raise UnusableInput(f"{file.location(row, column)}: {text!r}; expected {expected}")
