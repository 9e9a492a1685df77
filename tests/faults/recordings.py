"""Broken recordings: a valid one with one to three random faults, the same for the same seed and number."""

from __future__ import annotations

import gzip
import io
import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import polars.selectors as cs

from tests.faults.values import CELLS, FOLDER_NAMES, IDS, OF_BYTES, Draw, of_other_type, other_line, other_value, pick
from tests.faulty import RIG, good_tables

FLOOR = """
[floor]
walls_m = [[2.0, 0.0, 2.0, 3.0]]
outline_m = [[0.0, 0.0], [6.0, 0.0], [6.0, 5.0], [0.0, 5.0]]
"""
ROWS, FEW = 160, 6

Frames = dict[str, pl.DataFrame]


def broken_recording(seed: int, number: int, parent: Path, most: int = 3) -> tuple[Path, str]:
    """Writes a recording with at most so many faults into a new folder of `parent`; the folder, and its faults in words."""
    draw = np.random.default_rng([seed, number])
    name = pick(draw, FOLDER_NAMES) if draw.random() < 0.05 else "recording"
    folder = parent / name
    folder.mkdir()
    frames: Frames = {key: table.head(ROWS) for key, table in good_tables().items()}
    for key in [*frames]:
        if len(frames) > 1 and draw.random() < 0.3:
            del frames[key]
    rig, words = RIG + FLOOR, []
    kinds = draw.choice(len(KINDS), size=int(draw.integers(1, most + 1)), p=WEIGHTS)
    chosen = [KINDS[k] for k in kinds]
    for change in (c for c in chosen if c in OF_FRAMES):
        table = pick(draw, sorted(frames))
        if len(frames[table]) < FEW:
            continue
        try:
            frames[table] = change(draw, frames[table])
        except (pl.exceptions.ColumnNotFoundError, LookupError):
            continue  # an earlier change has removed the columns
        words.append(f"{change.__name__.strip('_')} of {table}")
    for change in (c for c in chosen if c in OF_RIG):
        rig = change(draw, rig)
        words.append(change.__name__.strip("_"))
    (folder / "rig.toml").write_bytes(rig.encode("utf-8", "surrogatepass"))
    typed = [c for c in chosen if c in OF_PARQUET]
    for table, frame in frames.items():
        kind = "parquet" if typed else pick(draw, ("csv", "csv.gz", "parquet"))
        for change in typed:
            column = pick(draw, frame.columns)
            frame = frame.with_columns(change(draw, frame[column]))
            words.append(f"{table}.{column} as {frame.schema[column]}")
        _write(frame, folder / f"{table}.{kind}")
    for change in (c for c in chosen if c in OF_TEXT):
        path = folder / pick(draw, sorted(p.name for p in folder.iterdir() if p.name != "rig.toml"))
        _rewrite(draw, path, change)
        words.append(f"{change.__name__.strip('_')} of {path.name}")
    for change in (c for c in chosen if c in OF_BYTES):
        path = folder / pick(draw, sorted(p.name for p in folder.iterdir()))
        path.write_bytes(change(draw, path.read_bytes()))
        words.append(f"{change.__name__.strip('_')} of {path.name}")
    words += [f"{change.__name__.strip('_')}: {change(draw, folder)}" for change in chosen if change in OF_FOLDER]
    return folder, ", ".join(words) + (f", named {name!r}" if name != "recording" else "")


def _write(frame: pl.DataFrame, path: Path) -> None:
    if path.suffix == ".parquet":
        written = io.BytesIO()  # polars takes no name that is not UTF-8
        frame.write_parquet(written)
        path.write_bytes(written.getvalue())
    else:
        data = frame.write_csv().encode("utf-8", "surrogatepass")
        path.write_bytes(gzip.compress(data, 1, mtime=0) if path.suffix == ".gz" else data)


def _rewrite(draw: Draw, path: Path, change: Callable[[Draw, str], str]) -> None:
    """Applies a change of text to a table as CSV, packed or not."""
    if path.suffix == ".parquet":
        frame = pl.read_parquet(path.read_bytes())
        text = frame.select(~(cs.nested() | cs.binary() | cs.duration())).write_csv()
        path.unlink()
        path = path.with_suffix(".csv")
    else:
        content = path.read_bytes()
        text = (gzip.decompress(content) if path.suffix == ".gz" else content).decode()
    changed = change(draw, text).encode("utf-8", "surrogatepass")
    path.write_bytes(gzip.compress(changed, 1, mtime=0) if path.suffix == ".gz" else changed)


# changes of a table's values


def _times(draw: Draw, frame: pl.DataFrame) -> pl.DataFrame:
    t, n = frame["t_s"].to_numpy().copy(), len(frame)
    one = int(draw.integers(n))
    ways = (
        lambda: t * 1000, lambda: t + 1.7e9, lambda: (t + 1.7e9) * 1e9, lambda: -t, lambda: t * 0, lambda: t[::-1], draw.permutation(n).astype,
        lambda: np.where(np.arange(n) == one, pick(draw, (1e20, -1e20, 1e15, -1.0, 1e6, np.nan)), t), lambda: t * 1e-300, lambda: t * 1e12,
        lambda: np.where(np.arange(n) < one, t, t - 5), lambda: np.where(np.arange(n) < one, t, t + 1e5), lambda: np.round(t), lambda: t + 1e17,
    )  # fmt: skip
    way = pick(draw, ways)
    return frame.with_columns(t_s=pl.Series(way(float) if way == ways[6] else way()))


def _units(draw: Draw, frame: pl.DataFrame) -> pl.DataFrame:
    numeric = [c for c in frame.columns if c.endswith(("_m", "_rad", "_mps2", "_radps")) or c in ("qw", "qx")]
    chosen = numeric if draw.random() < 0.5 else [pick(draw, numeric)]
    factor = pick(draw, (1e3, 1e-3, 57.29578, 0.0, -1.0, 1e-12, 1e14, 0.3048, float("nan")))
    return frame.with_columns(pl.col(chosen) * factor)


def _shifted(draw: Draw, frame: pl.DataFrame) -> pl.DataFrame:
    numeric = [c for c in frame.columns if c.endswith(("_m", "_rad", "_mps2", "_radps"))]
    return frame.with_columns(pl.col(pick(draw, numeric)) + pick(draw, (1e3, -1e5, 6.283, 1e7, 9.81, 1e14)))


def _missing(draw: Draw, frame: pl.DataFrame) -> pl.DataFrame:
    column, share = pick(draw, frame.columns), pick(draw, (0.01, 0.5, 0.99, 1.0))
    gone = pl.Series(draw.random(len(frame)) < share)
    return frame.with_columns(pl.when(gone).then(None).otherwise(pl.col(column)).alias(column))


def _other_ids(draw: Draw, frame: pl.DataFrame) -> pl.DataFrame:
    column = pick(draw, [c for c in ("tag", "anchor", "station") if c in frame.columns])
    one, new = pick(draw, frame[column].unique().sort().to_list()), pick(draw, IDS)
    if draw.random() < 0.1:
        return frame.with_columns(pl.int_range(len(frame)).cast(pl.String).alias(column))
    return frame.with_columns(
        pl.when(pl.col(column).eq_missing(pl.lit(one))).then(pl.lit(new)).otherwise(pl.col(column)).alias(column)
    )


def _fewer(draw: Draw, frame: pl.DataFrame) -> pl.DataFrame:
    kept = int(pick(draw, (0, 1, 2, 3, 5)))
    return frame.sample(kept, seed=int(draw.integers(1 << 30))) if draw.random() < 0.5 else frame.head(kept)


def _repeated(draw: Draw, frame: pl.DataFrame) -> pl.DataFrame:
    return pl.concat([frame] * int(draw.integers(2, 4)))


def _columns(draw: Draw, frame: pl.DataFrame) -> pl.DataFrame:
    column = pick(draw, frame.columns)
    ways = (
        lambda: frame.drop(column), lambda: frame.rename({column: column.upper()}), lambda: frame.rename({column: pick(draw, IDS)}),
        lambda: frame.with_columns(pl.col(column).alias(pick(draw, IDS))), lambda: frame.select(frame.columns[::-1]),
        lambda: frame.with_columns(pl.lit(0.1).alias(column.replace("_m", "_std_m").replace("_rad", "_std_rad"))),
        lambda: frame.with_columns(pl.lit(0.1).alias(f"extra_{k}") for k in range(300)), lambda: frame.select(column),
    )  # fmt: skip
    try:
        return pick(draw, ways)()
    except pl.exceptions.PolarsError:
        return frame.drop(column)


# changes of a table's text


def _cells(draw: Draw, text: str) -> str:
    lines = text.split("\n")
    column, value = int(draw.integers(lines[0].count(",") + 1)), pick(draw, CELLS)
    share = pick(draw, (0.0, 0.0, 0.3, 1.0))
    one = int(draw.integers(1, max(2, len(lines) - 1)))
    for k in range(1, len(lines) - 1):
        if k == one or draw.random() < share:
            cells = lines[k].split(",")
            cells[min(column, len(cells) - 1)] = value
            lines[k] = ",".join(cells)
    return "\n".join(lines)


def _lines(draw: Draw, text: str) -> str:
    lines = text.split("\n")
    k = int(draw.integers(len(lines)))
    line = lines[k]
    ways = (
        [], [line, line], ["", line], ["# comment", line], [line + ","], [line.rpartition(",")[0]], ['"' + line], [line + '"'], [lines[0], line],
        [line + "\r"], [line + "\r\r"], [line + "\x0b"], [line + "\x0c" + line], [line + "\u2028" + line], ["x" * 100_000], [line[: len(line) // 2]],
        [" " + line + " "], [line.replace(",", ";")], [line.replace(",", "\t")], [line.replace(",", ", ")], [line.replace(".", ",")],
        ["," * 5000], [line + "\x1a"], ['"' + line.replace(",", '","') + '"'], ["\ufeff" + line], ["sep=,", line],
    )  # fmt: skip
    lines[k : k + 1] = pick(draw, ways)
    return pick(draw, ("\n", "\n", "\n", "\r\n", "\r")).join(lines)


def _encoded_text(draw: Draw, text: str) -> str:
    return text.replace("T1", pick(draw, IDS))


# changes of the rig


def _rig_value(draw: Draw, text: str) -> str:
    return other_value(draw, text, r"(?<= = ).*$|-?\d+\.\d+")


def _rig_ids(draw: Draw, text: str) -> str:
    old, new = pick(draw, ("A1", "S1", "T1", "T2")), pick(draw, IDS)
    quoted = '"' + "".join(f"\\u{ord(c):04x}" if ord(c) < 32 or c in '"\\\x7f' else c for c in new) + '"'
    return re.sub(rf'"?\b{old}\b"?', lambda _: quoted, text)


def _rig_geometry(draw: Draw, text: str) -> str:
    ways = (
        lambda: re.sub(r"^(.A\d.) = .*$", r"\1 = [1.0, 1.0, 1.0]", text, flags=re.MULTILINE),
        lambda: re.sub(r"^(.A(\d).) = .*$", r"\1 = [\2.0, \2.0, 1.0]", text, flags=re.MULTILINE),
        lambda: re.sub(r"^.A[234]. = .*\n", "", text, flags=re.MULTILINE), lambda: re.sub(r"(\d+)\.(\d+)", r"\g<1>000.\2", text),
        lambda: re.sub(r"(\d+)\.(\d+)", r"0.000\g<1>\2", text), lambda: text.replace("antennas_m = [[0.02, 0.0], ", "antennas_m = ["),
        lambda: text.replace("wavelength_m = 0.0125", f"wavelength_m = {pick(draw, ('1e-300', '1e300', '125', '12.5'))}"),
        lambda: text + "".join(f'[tags."x{k}"]\nheight_m = 1.0\n' for k in range(2000)),
    )  # fmt: skip
    return pick(draw, ways)()


# changes of the folder


def _a_file(draw: Draw, folder: Path) -> Path:
    return folder / pick(draw, sorted(p.name for p in folder.iterdir() if p.is_file() and not p.is_symlink()))


def _links(draw: Draw, folder: Path) -> str:
    path = _a_file(draw, folder)
    target = pick(
        draw, ("itself", "nothing", "a folder", "/dev/zero", "/dev/null", "the file elsewhere", "/proc/self/mem")
    )
    content = path.read_bytes()
    path.unlink()
    if target == "the file elsewhere":
        elsewhere = folder.parent / "elsewhere"
        elsewhere.write_bytes(content)
        path.symlink_to(elsewhere)
    else:
        path.symlink_to({"itself": path, "nothing": folder / "gone", "a folder": folder.parent}.get(target, target))
    return f"{path.name} -> {target}"


def _special(draw: Draw, folder: Path) -> str:
    path = _a_file(draw, folder)
    what = pick(draw, ("pipe", "directory", "unreadable"))
    content = path.read_bytes()
    path.unlink()
    if what == "pipe":
        os.mkfifo(path)
    elif what == "directory":
        path.mkdir()
    else:
        path.write_bytes(content)
        path.chmod(0)
    return f"{path.name} is a {what}"


def _more_files(draw: Draw, folder: Path) -> str:
    name = pick(draw, ("ranges.csv", "Ranges.CSV", "range.csv", ".ranges.csv", "ranges.CSV.GZ", "truth.xlsx", "imu.parquet", "a\nb.csv", b"\xff.csv".decode("utf-8", "surrogateescape"),
                       "\x1b[31m.csv", "phase.csv", "tracks.parquet"))  # fmt: skip
    (folder / name).write_bytes(pick(draw, (b"", b"a,b\n1,2\n", bytes(range(256)))))
    return repr(name)


OF_FRAMES = (_times, _units, _shifted, _missing, _other_ids, _fewer, _repeated, _columns)
OF_TEXT = (_cells, _lines, _encoded_text)
OF_RIG = (_rig_value, other_line, _rig_ids, _rig_geometry)
OF_FOLDER = (_links, _special, _more_files)
OF_PARQUET = (of_other_type,)
KINDS: tuple[Callable, ...] = (*OF_FRAMES, *OF_TEXT, *OF_BYTES, *OF_RIG, *OF_FOLDER, *OF_PARQUET)
_SHARES = np.array([3 if kind in (_cells, _rig_value, of_other_type) else 1 for kind in KINDS], float)
WEIGHTS = _SHARES / _SHARES.sum()
