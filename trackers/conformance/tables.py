"""The contracts of what makes tables: a kind of measurement, and an importer, a function from a log to its tables."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.conformance import contract
from trackwright.trackers.conformance.contract import BrokenContract, NotApplicable, check
from trackwright.trackers.core.errors import UnusableInput, listed, require
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.exchange.importing import import_frames
from trackwright.trackers.recordings.checks.all_checks import check as check_recording
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import Kind, Sensors

ROWS, SHIFT = 200, np.array([64.0, -32.0, 0.0])  # readings along a closed path, and how far its site is moved, m


def kind_checks(kind: Kind, rig: Rig, seed: int = 0) -> list[contract.Check]:
    """The checks of a kind of measurement at positions among the anchors or stations of `rig`.

    `predicted` gives one finite number per column and row, row by row whatever the numbering of the sensors, and the
    same where a site is moved as a whole, since recordings in map coordinates are tracked about one nearby. Raises
    UnusableInput for an object of another kind.
    """
    require(isinstance(kind, Kind), "check_kind", kind, "an object of Kind")
    rng, ids, there = np.random.default_rng(seed), list(kind.places(rig)), list(kind.places(rig).values())
    antennas = max((len(s.antennas) for s in rig.stations.values() if s.antennas is not None), default=1)
    n_columns = antennas if kind.numbered else len(kind.columns)
    places = np.array(there if there else [[-4.0, -3.0, 0.0], [4.0, 3.0, 2.0]])
    turn = 2 * np.pi * np.arange(ROWS)[:, None] / ROWS + np.array([0.0, np.pi / 2, 1.0])
    positions = places.mean(axis=0) + np.maximum(np.ptp(places, axis=0) / 3, 0.5) * np.sin(turn)

    @cache
    def number() -> np.ndarray:
        k = len(kind.sensors)
        assert len(ids) >= k, f"kind {kind.name}: the rig has {len(ids)} {kind.noun}s, expected {k} at least"
        return np.array([rng.choice(len(ids), k, replace=False) for _ in range(ROWS)]).reshape(ROWS, k)

    def sensors(backwards: bool = False) -> Sensors:
        numbers = len(ids) - 1 - number() if backwards else number()
        return kind.sensors_of(rig, ids[::-1] if backwards else ids, numbers, n_columns)

    @cache
    def predicted() -> np.ndarray:
        if kind.predicted is None:
            raise NotApplicable("positions do not predict the kind: predicted is None")
        return kind.values_at(positions, sensors())

    def same(mine: np.ndarray, expected: np.ndarray, where: str, fix: str) -> None:
        off = np.abs(mine - expected).max()
        assert off <= 1e-6, f"kind {kind.name}: values {where} are off by {off:.3g}; usual fix: {fix}"

    @check()
    def values() -> str:
        for row in np.argwhere(~np.isfinite(predicted()).all(axis=1)).ravel():
            found = f"kind {kind.name}: predicted gives {listed(predicted()[row])} at {positions[row].round(2)} m"
            raise BrokenContract(f"{found}; usual fix: np.maximum around the argument of a root")
        return f"{predicted().min():.3g} to {predicted().max():.3g} in {ROWS} readings"

    @check(values)
    def order() -> None:
        order = rng.permutation(ROWS)[: ROWS // 2]
        mixed = kind.values_at(positions[order], sensors()._replace(number=sensors().number[order]))
        same(mixed, predicted()[order], "for half of the rows in another order", "no mean, sum or sort over rows")
        found = kind.values_at(positions, sensors(backwards=True))
        same(found, predicted(), "in another numbering of the anchors or stations", "places by `sensors.distances`")

    @check(order)
    def moved_site() -> None:
        if kind.position:
            raise NotApplicable("the values are a position, which moves with the site")
        moved = kind.values_at(positions + SHIFT, sensors()._replace(places=sensors().places + SHIFT))
        same(moved, predicted(), "of the site moved as a whole", "positions less sensors.places")

    return [values, order, moved_site]


def importer_checks(
    importer: Callable[[Path], Any], path: Path | str, rig: Rig | Path | str | None = None, tag: str | None = None
) -> list[contract.Check]:
    """The checks of a function that reads logs, with one log; `rig` and `tag` as of `import_frames`.

    Its tables are a recording in which `check` finds no error; a second reading gives the same; of a text that ends
    early the rows are the first rows of the whole, or it is refused by UnusableInput, as an empty one is. Raises
    UnusableInput for an object of another kind.
    """
    require(callable(importer), "check_importer", importer, "a function from a path to tables")
    source, name = Path(path), getattr(importer, "__name__", type(importer).__name__)

    def recording_of(frames: Any) -> RecordingFolder:
        fits = isinstance(frames, Mapping) and frames
        assert fits, f"{name} gives {type(frames).__name__} of {source.name}, expected frames by the names of tables"
        return import_frames(frames, rig, tag=tag)

    whole = cache(lambda: recording_of(importer(source)))

    @check()
    def tables() -> str:
        return f"rows: {listed(f'{table} {len(rows)}' for table, rows in whole().tables.items())}"

    @check(tables)
    def again() -> None:
        found, none = recording_of(importer(source)).tables, pl.DataFrame()
        for table in {**whole().tables, **found}:
            same = whole().tables.get(table, none).equals(found.get(table, none))
            assert same, f"{name} gives another table {table} when the log is read again, expected the same"

    @check(tables)
    def recording() -> None:
        for one in check_recording(whole()):
            assert one.level != "error", f"`check` of what {name} gives says: {one.where}: {one.message}"

    def begins(lines: list[str], what: str) -> str:
        """Asserts that a log of these lines alone has the first rows of the whole, or is refused."""
        with tempfile.TemporaryDirectory() as scratch:
            log = Path(scratch) / source.name
            log.write_bytes("".join(lines).encode("utf-8"))
            try:
                frames = importer(log)
                found = recording_of(frames).tables if frames or not isinstance(frames, Mapping) else {}
            except UnusableInput:
                return "refused"
            except Exception as error:
                fix = "usual fix: raise tw.UnusableInput with the line that is wrong"
                raise BrokenContract(f"{name} stops at {what} by {type(error).__name__}: {error}; {fix}") from error
        for table, rows in found.items():
            first = whole().tables.get(table, rows.clear()).head(len(rows) if lines else 0)
            assert rows.equals(first), f"{name} gives other rows of {table} for {what}, expected the first of the whole"
        return "the first rows of the whole"

    @check(tables)
    def early_end() -> str:
        try:
            lines = source.read_bytes().decode("utf-8").splitlines(keepends=True)
        except (OSError, UnicodeDecodeError):
            raise NotApplicable("the log is a folder or no text") from None
        return begins(lines[: (len(lines) + 1) // 2], "the first half of the log")

    @check(tables)
    def empty_log() -> str:
        return begins([], "an empty log")

    return [tables, again, recording, early_end, empty_log]


check_kind = contract.reported(kind_checks)
check_importer = contract.reported(importer_checks)
