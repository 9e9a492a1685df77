"""The contracts of what makes tables: a kind of measurement, and an importer, a function from a log to its tables."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from trackwright.trackers.conformance.parts import BrokenContract, Check, NotApplicable, asserted
from trackwright.trackers.core.errors import UnusableInput, listed, require
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.exchange.importing import import_frames
from trackwright.trackers.recordings.checks.all_checks import check as check_recording
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import Kind, Sensors

ROWS, SHIFT = 200, np.array([64.0, -32.0, 0.0])  # readings along a closed path, and how far its site is moved, m


def kind_checks(kind: Kind, rig: Rig) -> list[Check]:
    """The checks of a kind of measurement at positions among the anchors or stations of `rig`.

    `predicted` gives one finite number per column and row, row by row whatever the numbering of the sensors, and the
    same where a site is moved as a whole, since recordings in map coordinates are tracked about one nearby.
    """
    require(isinstance(kind, Kind), "check_kind", kind, "an object of Kind")
    rng, ids, there = np.random.default_rng(0), list(kind.places(rig)), list(kind.places(rig).values())
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

    predicted = cache(lambda: kind.values_at(positions, sensors()))

    def same(mine: np.ndarray, expected: np.ndarray, where: str, fix: str) -> None:
        off = np.abs(mine - expected).max()
        assert off <= 1e-6, f"kind {kind.name}: values {where} are off by {off:.3g}; usual fix: {fix}"

    @Check
    def values() -> None:
        for row in np.argwhere(~np.isfinite(predicted()).all(axis=1)).ravel():
            found = f"kind {kind.name}: predicted gives {listed(predicted()[row])} at {positions[row].round(2)} m"
            raise BrokenContract(f"{found}; usual fix: np.maximum around the argument of a root")

    @Check
    def order() -> None:
        expected, order = predicted(), rng.permutation(ROWS)[: ROWS // 2]
        mixed = kind.values_at(positions[order], sensors()._replace(number=sensors().number[order]))
        same(mixed, expected[order], "for half of the rows in another order", "no mean, sum or sort over rows")
        found = kind.values_at(positions, sensors(backwards=True))
        same(found, expected, "in another numbering of the anchors or stations", "places by `sensors.distances`")

    @Check
    def moved_site() -> None:
        if kind.position:
            raise NotApplicable("the values are a position, which moves with the site")
        moved = kind.values_at(positions + SHIFT, sensors()._replace(places=sensors().places + SHIFT))
        same(moved, predicted(), "of the site moved as a whole", "positions less sensors.places")

    return [] if kind.predicted is None else [values, order, moved_site]


def importer_checks(
    importer: Callable[[Path], Any], path: Path | str, rig: Rig | Path | str | None = None, tag: str | None = None
) -> list[Check]:
    """The checks of a function that reads logs, with one log; `rig` and `tag` as of `import_frames`.

    Its tables are a recording in which `check` finds no error; an empty log has none, or is refused by UnusableInput.
    """
    require(callable(importer), "check_importer", importer, "a function from a path to tables")
    source, name = Path(path), getattr(importer, "__name__", type(importer).__name__)

    def recording_of(frames: Any) -> RecordingFolder:
        fits = isinstance(frames, Mapping) and frames
        assert fits, f"{name} gives {type(frames).__name__} of {source.name}, expected frames by the names of tables"
        return import_frames(frames, rig, tag=tag)

    @Check
    def recording() -> None:
        for one in check_recording(recording_of(importer(source))):
            assert one.level != "error", f"`check` of what {name} gives says: {one.where}: {one.message}"

    @Check
    def empty_log() -> None:
        with tempfile.TemporaryDirectory() as scratch, suppress(UnusableInput):
            log = Path(scratch) / source.name
            log.touch()
            frames = importer(log)
            rows = {} if isinstance(frames, Mapping) and not frames else recording_of(frames).tables
            assert not any(map(len, rows.values())), f"{name} gives rows of an empty log; expected none"

    return [recording, empty_log]


check_kind = asserted(kind_checks)
check_importer = asserted(importer_checks)
