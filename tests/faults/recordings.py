"""Broken recordings: a valid one with one to three random faults, the same for the same seed and number."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
import polars as pl

from tests.faulty import RIG, good_tables

Draw = np.random.Generator

VALUES = (
    "", " ", "nan", "inf", "-inf", "1e308", "1e400", "5e-324", "1e20", "-0", "0", "1,5", "1_000", "½", "--1", ".", "1e", "NULL", "true",
    "12:30:00", "2024-01-01T00:00:00Z", '"', "\t7", "\x00", "\x1b[31m", "\u2028", "\ufeff", "a" * 5000, "9" * 400, "A1", "T1 ", "-1", "360",
)  # fmt: skip
"""What a cell or an id may hold."""

TOML = ("nan", "inf", "1e400", "0", "-1", "true", '""', "[]", "{}", "[[]]", "1979-05-27", "9" * 400, "[nan, 0, 0]", "[1, 2]", "[true, true, true]", "")  # fmt: skip


def pick(draw: Draw, among):
    """One of a sequence."""
    return among[int(draw.integers(len(among)))]


def broken_recording(seed: int, number: int, parent: Path) -> tuple[Path, str]:
    """Writes a recording with faults into a new folder of `parent`; the folder, and its faults in words."""
    draw = np.random.default_rng([seed, number])
    folder, words, rig = parent / "recording", [], RIG
    folder.mkdir()
    frames = {name: table.head(160) for name, table in good_tables().items()}
    for _ in range(int(draw.integers(1, 4))):
        table, change = pick(draw, sorted(frames)), pick(draw, (*OF_FRAMES, of_rig))
        words.append(f"{change.__name__} {table}")
        if change is of_rig:
            rig = of_rig(draw, rig)
        elif len(frames[table]):
            frames[table] = change(draw, frames[table])
    (folder / "rig.toml").write_text(rig)
    for name, frame in frames.items():
        path, written = folder / f"{name}.{pick(draw, ('csv', 'parquet'))}", io.BytesIO()
        if path.suffix == ".csv":
            frame = frame.select(pl.all().cast(pl.String, strict=False).fill_null(""))
        (frame.write_csv if path.suffix == ".csv" else frame.write_parquet)(written)
        path.write_bytes(written.getvalue())
    if draw.random() < 0.5:
        path, change = pick(draw, sorted(folder.iterdir())), pick(draw, OF_BYTES)
        path.write_bytes(change(draw, path.read_bytes()))
        words.append(f"{change.__name__} {path.name}")
    return folder, ", ".join(words)


@np.errstate(over="ignore")
def times(draw: Draw, frame: pl.DataFrame) -> pl.DataFrame:
    """Times of other units, backwards, equal, with a jump or not finite."""
    t = frame["t_s"].cast(pl.Float64, strict=False).fill_null(0.0).to_numpy()
    jump = np.where(np.arange(len(t)) == int(draw.integers(len(t))), pick(draw, (1e20, -1e20, 1e6, np.nan)), t)
    return frame.with_columns(t_s=pl.Series(pick(draw, (t * 1e3, t + 1.7e9, -t, t * 0, t[::-1], jump, t * 1e-300))))


def units(draw: Draw, frame: pl.DataFrame) -> pl.DataFrame:
    """A column, scaled."""
    column = pick(draw, frame.columns[1:])
    factor = pick(draw, (1e3, 1e-3, 57.3, 0.0, -1.0, 1e14, float("nan")))
    return frame.with_columns(pl.col(column).cast(pl.Float64, strict=False) * factor)


def values(draw: Draw, frame: pl.DataFrame) -> pl.DataFrame:
    """Another value in one cell, some or all of a column."""
    column, other = pick(draw, frame.columns), pick(draw, VALUES)
    hit = draw.random(len(frame)) < pick(draw, (0.02, 0.5, 1.0))
    cells = frame[column].cast(pl.String, strict=False).to_list()
    return frame.with_columns(
        pl.Series(column, [other if h else c for h, c in zip(hit, cells, strict=True)], pl.String)
    )


def missing(draw: Draw, frame: pl.DataFrame) -> pl.DataFrame:
    """Cells, rows or a column that are not there."""
    column, gone = pick(draw, frame.columns), pl.Series(draw.random(len(frame)) < pick(draw, (0.01, 0.5, 1.0)))
    ways = (
        frame.drop(column),
        frame.filter(~gone),
        frame.with_columns(pl.when(~gone).then(pl.col(column)).alias(column)),
    )
    return pick(draw, ways)


def of_rig(draw: Draw, text: str) -> str:
    """rig.toml with another value, a line less or twice, or anchors in one place."""
    lines = text.splitlines(keepends=True)
    k = int(draw.integers(len(lines)))
    place = pick(draw, [*re.finditer(r"(?<= = ).*$|-?\d+\.\d+", text, re.MULTILINE)])
    return pick(draw, (
        text[: place.start()] + pick(draw, TOML) + text[place.end() :], "".join(lines[:k] + lines[k + 1 :]), "".join(lines[:k] + lines[k:][:1] + lines[k:]),
        re.sub(r'^("A\d") = .*$', r"\1 = [1.0, 1.0, 1.0]", text, flags=re.MULTILINE),
    ))  # fmt: skip


def flipped(draw: Draw, data: bytes) -> bytes:
    """Some bytes changed."""
    changed = bytearray(data)
    for at in draw.integers(max(len(changed), 1), size=8) if changed else ():
        changed[at] = int(draw.integers(256))
    return bytes(changed)


def cut(draw: Draw, data: bytes) -> bytes:
    return data[: int(draw.integers(len(data) + 1))]


def encoded(draw: Draw, data: bytes) -> bytes:
    return data.decode("latin-1").encode(pick(draw, ("utf-16", "utf-32", "utf-8-sig", "cp037")), "replace")


OF_FRAMES, OF_BYTES = (times, units, values, missing), (flipped, cut, encoded)
