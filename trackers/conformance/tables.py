"""The contracts of what makes tables: a kind of measurement, and an importer, a function from a log to its tables."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.conformance.contract import (
    BrokenContract,
    Check,
    NotApplicable,
    check,
    reported,
    require_part,
)
from trackwright.trackers.core.errors import UnusableInput, listed, one_line
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.exchange.imported import import_frames
from trackwright.trackers.recordings.checks.all_checks import check as check_recording
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording, write_recording
from trackwright.trackers.recordings.kinds import KINDS, Kind, Sensors, add_kind, wrapped

ROWS, SHIFT = 200, np.array([64.0, -32.0, 0.0])
"""Readings of a recording, ten a second along a closed path, and how far its site is moved, m."""


def kind_checks(kind: Kind, rig: Rig, seed: int = 0) -> list[Check]:
    """The checks of a kind of measurement at positions among the anchors or stations of `rig`.

    `predicted` gives one finite number per column and row, row by row whatever the numbering of the sensors, and the
    same where a site is moved as a whole, since recordings in map coordinates are tracked about an origin nearby; the
    numbers fit what the kind declares; a recording of them is written, read and checked without an error. Raises
    UnusableInput for an object of another kind.
    """
    require_part("check_kind", kind)
    rng, ids, there = np.random.default_rng(seed), list(kind.places(rig)), list(kind.places(rig).values())
    antennas = max((len(s.antennas) for s in rig.stations.values() if s.antennas is not None), default=1)
    columns = list(kind.columns[:1]) * antennas if kind.numbered else list(kind.columns)
    names = [column.name.replace("{n}", f"{n + 1}") for n, column in enumerate(columns)]
    places = np.array(there if there else [[-4.0, -3.0, 0.0], [4.0, 3.0, 2.0]])
    turn = 2 * np.pi * np.arange(ROWS)[:, None] / ROWS + np.array([0.0, np.pi / 2, 1.0])
    positions = places.mean(axis=0) + np.maximum(np.ptp(places, axis=0) / 3, 0.5) * np.sin(turn)

    @cache
    def number() -> np.ndarray:
        k = len(kind.sensors)
        few = f"the rig has {len(ids)} {kind.noun}s, expected {k} at least, one for each of {listed(kind.sensors)}"
        assert len(ids) >= k, f"kind {kind.name}: {few}; usual fix: check it with a rig of a site that measures it"
        return np.array([rng.choice(len(ids), k, replace=False) for _ in range(ROWS)]).reshape(ROWS, k)

    def sensors(backwards: bool = False) -> Sensors:
        numbers = len(ids) - 1 - number() if backwards else number()
        return kind.sensors_of(rig, ids[::-1] if backwards else ids, numbers, len(columns))

    @cache
    def predicted() -> np.ndarray:
        if kind.predicted is None:
            raise NotApplicable("positions do not predict the kind: predicted is None")
        return kind.values_at(positions, sensors())

    def same(mine: np.ndarray, expected: np.ndarray, where: str, fix: str) -> None:
        off = np.abs(mine - expected)
        row, column = np.unravel_index(int(np.where(np.isnan(off), np.inf, off).argmax()), off.shape)
        assert off.max() <= 1e-6, (
            f"kind {kind.name}: value {column} of reading {row} is {mine[row, column]:.6g} {where}, expected "
            f"{expected[row, column]:.6g} as before; usual fix: {fix}"
        )

    @check()
    def values() -> str:
        for row in np.argwhere(~np.isfinite(predicted()).all(axis=1)).ravel():
            raise BrokenContract(
                f"kind {kind.name}: predicted gives {listed(predicted()[row])} at {positions[row].round(2)} m, "
                "expected finite numbers; usual fix: np.maximum around the argument of a root"
            )
        found = predicted()
        return f"{found.shape[1]} for each of {ROWS} readings, {found.min():.3g} to {found.max():.3g}"

    @check(values)
    def rows() -> None:
        order = rng.permutation(ROWS)[: ROWS // 2]
        mixed = kind.values_at(positions[order], sensors()._replace(number=sensors().number[order]))
        same(mixed, predicted()[order], "for half of the rows in another order", "no mean, sum or sort over rows")

    @check(rows)
    def numbering() -> None:
        fix = "the places of a reading are sensors.places[sensors.number[:, k]], as `sensors.distances` takes them"
        found = kind.values_at(positions, sensors(backwards=True))
        same(found, predicted(), "in another numbering of the anchors or stations", fix)

    @check(numbering)
    def moved_site() -> None:
        if kind.position:
            raise NotApplicable("the values are a position, which moves with the site")
        moved = kind.values_at(positions + SHIFT, sensors()._replace(places=sensors().places + SHIFT))
        fix = "positions less sensors.places, as `sensors.distances` has it"
        same(moved, predicted(), f"of the site moved by {SHIFT[:2].round()} m as a whole", fix)

    @check(numbering)
    def declared() -> str:
        for column, name, least in zip(columns, names, predicted().min(axis=0), strict=True):
            found = f"kind {kind.name}: predicted {name} is {least:.3g} in a row, though the column is positive"
            assert least > 0 or not column.positive, f"{found}; usual fix: leave positive=True out"
        if kind.difference:
            first, second = (sensors().places[number()[:, k]] for k in range(2))
            over = (np.abs(predicted()[:, 0]) - np.linalg.norm(first - second, axis=1)).max()
            found = f"a predicted difference exceeds the distance of its two anchors by {over:.3g} m"
            assert over <= 1e-6, f"kind {kind.name}: {found}; usual fix: leave difference=True out"
        shown = ["difference"] * kind.difference + ["positive"] * any(column.positive for column in columns)
        return f"as declared: {listed(shown)}" if shown else "no bound that predictions could exceed"

    @check(declared)
    def recording() -> str:
        head = pl.DataFrame({"t_s": 0.1 * np.arange(ROWS), "tag": ["1"] * ROWS})
        of = {name: np.array(ids)[number()[:, j]] for j, name in enumerate(kind.sensors)}
        of |= dict(zip(names, wrapped(predicted(), names).T, strict=True))
        truth = head.with_columns(pl.Series(f"{axis}_m", positions[:, j]) for j, axis in enumerate("xyz"))
        tables = {kind.name: head.with_columns(pl.Series(name, x) for name, x in of.items()), "truth": truth}
        with _among_kinds(kind), tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch) / "recording"
            write_recording(RecordingFolder("kind", None, replace(rig, tags={}, bodies={}), tables), folder)
            fix = "usual fix: bias, large and floor of its columns in their unit"
            return _without_error(read_recording(folder), f"a recording of kind {kind.name} without errors", fix)

    return [values, rows, numbering, moved_site, declared, recording]


def importer_checks(
    importer: Callable[[Path], Mapping[str, Any]],
    path: Path | str,
    rig: Rig | Path | str | None = None,
    tag: str | None = None,
) -> list[Check]:
    """The checks of a function that reads logs, with one log; `rig` and `tag` as of `import_frames`.

    Its tables are a recording in which `check` finds no error; a second reading gives the same and the log is as it
    was; a text has the same rows with the line ends of another system; of a log that ends early the rows are the
    first rows of the whole, or it is refused by UnusableInput, as an empty one is. Raises UnusableInput for an object
    of another kind.
    """
    require_part("check_importer", importer)
    source, name = Path(path), getattr(importer, "__name__", type(importer).__name__)

    def recording_of(frames: Any) -> RecordingFolder:
        fits = isinstance(frames, Mapping) and frames
        found = f"{name} gives {type(frames).__name__} of {source.name}"
        assert fits, f"{found}, expected frames by the names of tables; usual fix: return {{'ranges': frame}}"
        return import_frames(frames, rig, tag=tag)

    def contents() -> dict[Path, tuple[int, int]]:
        """Sizes and times of what is in the log, or beside one that is no folder."""
        there = source.rglob("*") if source.is_dir() else source.parent.iterdir()
        return {file: (of.st_size, of.st_mtime_ns) for file in there if file.exists() for of in [file.stat()]}

    before = cache(contents)

    @cache
    def whole() -> RecordingFolder:
        before()
        return recording_of(importer(source))

    def other_tables(found: Mapping[str, pl.DataFrame]) -> list[str]:
        none = pl.DataFrame()
        return [
            one for one in {**whole().tables, **found} if not whole().tables.get(one, none).equals(found.get(one, none))
        ]

    def text() -> str:
        try:
            return source.read_bytes().decode("utf-8")
        except (OSError, UnicodeDecodeError):
            raise NotApplicable("the log is a folder or no text") from None

    def tables_of(lines: str, what: str) -> Mapping[str, pl.DataFrame] | None:
        """The tables of a log with another text; None where it is refused."""
        with tempfile.TemporaryDirectory() as scratch:
            log = Path(scratch) / source.name
            log.write_bytes(lines.encode("utf-8"))
            try:
                frames = importer(log)
            except UnusableInput:
                return None
            except Exception as error:
                found = f"{name} stops at {what} by {type(error).__name__}: {one_line(error)[:100]}"
                fix = "raise tw.UnusableInput with the line of the log that is wrong, or skip the line"
                raise BrokenContract(f"{found}, expected UnusableInput; usual fix: {fix}") from error
            try:
                return {} if isinstance(frames, Mapping) and not frames else recording_of(frames).tables
            except UnusableInput:
                return None

    @check()
    def tables() -> str:
        sizes = listed(f"{table} {len(rows)}" for table, rows in whole().tables.items())
        assert all(map(len, whole().tables.values())), f"{name} gives a table without rows ({sizes}), leave it out"
        return f"rows: {sizes}"

    @check(tables)
    def again() -> None:
        changed = other_tables(recording_of(importer(source)).tables)
        assert not changed, (
            f"{name} gives another table {listed(changed)} when the log is read again, expected the same"
        )
        written = listed(sorted({file.name for file, _ in before().items() ^ contents().items()}))
        assert not written, f"{name} changes {written}, expected the log and its folder as they were"

    @check(tables)
    def recording() -> str:
        return _without_error(whole(), f"what {name} gives", "usual fix: times in s, distances in m, angles in rad")

    @check(tables)
    def line_ends() -> None:
        plain = text().replace("\r\n", "\n")
        for words, lines in (("\\n", plain), ("\\r\\n", plain.replace("\n", "\r\n"))):
            found = tables_of(lines, f"lines that end with {words}")
            same, fix = found is not None and not other_tables(found), "path.read_text().splitlines(), which knows both"
            assert same, f"{name} gives other tables where lines end with {words}, expected the same; usual fix: {fix}"

    @check(tables)
    def early_end() -> str:
        lines = text().splitlines(keepends=True)
        found = tables_of("".join(lines[: (len(lines) + 1) // 2]), "a log that ends early")
        for table, rows in (found or {}).items():
            assert rows.equals(whole().tables.get(table, rows.clear()).head(len(rows))), (
                f"{name} gives other rows of {table} for the first half of the log, expected those of the whole; usual "
                "fix: no number from the end of the log"
            )
        return "a log that ends early is refused" if found is None else "the first rows of the whole"

    @check(tables)
    def empty_log() -> str:
        found = tables_of("", "an empty log")
        rows = sum(map(len, (found or {}).values()))
        assert not rows, f"{name} gives {rows} rows of an empty log, expected none; usual fix: rows from the log alone"
        return "refused" if found is None else "no rows"

    return [tables, again, recording, line_ends, early_end, empty_log]


check_kind, check_importer = reported(kind_checks), reported(importer_checks)


def _without_error(recording: RecordingFolder, what: str, fix: str) -> str:
    found = check_recording(recording)
    for one in found:
        assert one.level != "error", f"`check` of {what} says: {one.where}: {one.message}; {fix}"
    return f"{len(found)} results, none an error"


@contextmanager
def _among_kinds(kind: Kind) -> Iterator[None]:
    """The kind among those that recordings are read with."""
    before = dict(KINDS)
    if kind.name not in KINDS:
        add_kind(kind)
    KINDS[kind.name] = kind
    try:
        yield
    finally:
        KINDS.clear()
        KINDS.update(before)
