"""Texts, numbers, types and bytes that programs stumble over, drawn by a random generator."""

from __future__ import annotations

import gzip
import re

import numpy as np
import polars as pl

Draw = np.random.Generator

MARKUP = "</script><script>alert(1)</script><img src=x onerror=alert(1)>"
"""Text that a page has to escape."""

CELLS = (
    "", " ", "nan", "NaN", "inf", "-inf", "Infinity", "1e308", "-1e308", "1e400", "1e-400", "5e-324", "1e15", "1e16", "1e20",
    "1e21", "-0", "0", "1,5", "1;5", "0x10", "1_000", "١٢", "１２", "½", "--1", "+5", "5.", ".5", ".", "e", "1e", "NULL", "NA",
    "N/A", "#DIV/0!", "true", "12:30:00", "2024-02-30", "2024-01-01T00:00:00Z", '"', '""', "'", "\\", "\t7", "\x00", "\x1b[31m",
    "\x7f", "\x85", "\u2028", "\ufeff", "\u200b7", "\U0001f600", "a" * 5000, "9" * 400, "0." + "3" * 400, MARKUP, "=1+1",
    "{{ 7 * 7 }}", "%s%n", "../../x", "A1", "S1", "T1", "a1", "T1 ", "é", "e\u0301", "-1", "1e9", "1e-9", "360", "6.2831853",
)  # fmt: skip
"""What a cell may hold."""

TOML = (
    "nan", "inf", "-inf", "1e400", "-1e308", "5e-324", "0", "-0.0", "-1", "1", "true", "false", '""', '"text"', "[]", "{}", "[[]]",
    "[[], []]", "1979-05-27", "07:32:00", "1979-05-27T07:32:00Z", "0x10", "9" * 400, "9" * 5000, "1e15", "1e7", "1e-9",
    "[1.0, 2.0, 3.0]", "[1, 2]", "[nan, 0, 0]", "[1e308, 1e308, 1e308]", '["a", "b", "c"]', "[true, true, true]", "[" * 3000 + "]" * 3000,
    '{a = {b = {c = 1}}}', '"\\u0000"', '"\\u001b[31m"', f'"{MARKUP}"', '"../../x"', "[0.0, 0.0, 0.0]", "[0.0, 0.0, 0.0, 0.0]",
    "[[0.0, 0.0], [0.0, 0.0]]", '"""a\nb"""', "'" + "a" * 5000 + "'", "[[1.0, 0.0], [0.0, 1.0]]", "", "=", "1.2.3", "[1, [2]]",
)  # fmt: skip
"""What may stand for a value of a TOML file."""

IDS = (
    "", " ", "A1", "T1", "a.b", "A1 ", "\t", "\n", "\x00", "\x1b[2J", "\x7f", "é", "e\u0301", "\u202eabc", MARKUP, "x" * 3000, "/", "..",
    "tag", "t_s", "0", "-1", "nan", "None", "{{ 7 * 7 }}", "[bold]x[/bold]", "[/]", "$x$", "%", "a,b", 'a"b', "\U0001f600", "\u2028",
)  # fmt: skip
"""Ids of anchors, stations and tags."""

FOLDER_NAMES = (
    "[bold]x", "[\u2215]", "a b", "a\nb", "\x1b[31mred", "$x_1$", "{{ 7 * 7 }}", MARKUP.replace("/", "-"), "-n", "é", "e\u0301",
    b"\xff\xfe".decode("utf-8", "surrogateescape"), "x" * 200, "%d", "a\tb", "\u202eabc", "a'b\"c", "~", ".hidden", "a.parquet",
)  # fmt: skip
"""Names of recording folders."""

ENCODINGS = ("utf-16", "utf-16-le", "utf-32", "utf-8-sig", "cp037", "utf-7", "latin-1", "cp1252", "shift_jis")


def pick(draw: Draw, among):
    """One of a sequence; raises LookupError where it is empty."""
    if not len(among):
        raise LookupError("nothing to pick from")
    return among[int(draw.integers(len(among)))]


def of_other_type(draw: Draw, column: pl.Series) -> pl.Series:
    """A column of a Parquet table in another type, where polars can convert it; else all null."""
    ways = (
        lambda x: x.cast(pl.Float32, strict=False), lambda x: x.cast(pl.Int8, strict=False), lambda x: x.cast(pl.UInt64, strict=False),
        lambda x: x.cast(pl.Int64, strict=False).cast(pl.Datetime("ms")), lambda x: x.cast(pl.Int32, strict=False).cast(pl.Date),
        lambda x: x.cast(pl.Int64, strict=False).cast(pl.Duration("us")), lambda x: x.cast(pl.Decimal(20, 3), strict=False),
        lambda x: x.cast(pl.Boolean, strict=False), lambda x: x.cast(pl.String).cast(pl.Binary), lambda x: x.cast(pl.String).cast(pl.Categorical),
        lambda x: x.cast(pl.String), lambda x: x.implode().gather([0] * len(x)), lambda x: x.to_frame().to_struct(x.name),
        lambda x: pl.Series(x.name, [None] * len(x)), lambda x: x.cast(pl.Int64, strict=False).cast(pl.Time),
        lambda x: pl.Series(x.name, [[1.0, 2.0]] * len(x), dtype=pl.Array(pl.Float64, 2)), lambda x: x.cast(pl.Int128, strict=False),
        lambda x: pl.Series(x.name, [float("nan")] * len(x)), lambda x: pl.Series(x.name, [float("inf")] * len(x)),
    )  # fmt: skip
    try:
        return pick(draw, ways)(column).alias(column.name)
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException):
        return pl.Series(column.name, [None] * len(column))


def other_value(draw: Draw, text: str, values: str) -> str:
    """The text of a TOML or JSON file with another value in place of one that the pattern `values` finds, if any."""
    found = [*re.finditer(values, text, re.MULTILINE)]
    if not found:
        return text
    one = pick(draw, found)
    return text[: one.start()] + pick(draw, TOML) + text[one.end() :]


def other_line(draw: Draw, text: str) -> str:
    """The text of a TOML file with one line left out, repeated, followed by another, cut short or replaced."""
    lines = text.split("\n")
    k = int(draw.integers(len(lines)))
    ways = (
        [],
        [lines[k]] * 2,
        [lines[k], pick(draw, lines)],
        ["[x]"],
        [lines[k][: len(lines[k]) // 2]],
        [f"{pick(draw, TOML)} = 1"],
    )
    lines[k : k + 1] = pick(draw, ways)
    return "\n".join(lines)


def _flipped(draw: Draw, data: bytes) -> bytes:
    changed = bytearray(data)
    for at in draw.integers(len(changed), size=min(len(changed), int(pick(draw, (1, 1, 2, 8, 64))))) if changed else ():
        changed[at] = int(draw.integers(256))
    return bytes(changed)


def _cut(draw: Draw, data: bytes) -> bytes:
    return data[: int(draw.integers(len(data) + 1))]


def _spliced(draw: Draw, data: bytes) -> bytes:
    at = int(draw.integers(len(data) + 1))
    new = pick(
        draw, (b"\0" * 100, bytes(range(256)), b"\xff\xfe", b"\r", b"\x1f\x8b", b"PAR1", draw.bytes(64), data[:at])
    )
    return data[:at] + new + (data[at:] if draw.random() < 0.5 else data[at + len(new) :])


def _encoded(draw: Draw, data: bytes) -> bytes:
    return data.decode("latin-1").encode(pick(draw, ENCODINGS), "replace")


def _packed_again(draw: Draw, data: bytes) -> bytes:
    return gzip.compress(data, 1, mtime=0)


OF_BYTES = (_flipped, _cut, _spliced, _encoded, _packed_again)
