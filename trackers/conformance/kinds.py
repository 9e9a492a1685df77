"""The contract of a kind of measurement: what it predicts, and a recording of it written, read and checked."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import polars as pl
from jaxtyping import Float

from trackwright.trackers.conformance.contract import BrokenContract, Check, NotApplicable, Report, report, require_part
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.checks.all_checks import check
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording, write_recording
from trackwright.trackers.recordings.kinds import KINDS, Kind, Sensors, add_kind, wrapped

ROWS = 200
"""Readings of the recording, ten a second along a closed path."""

SHIFT = np.array([64.0, -32.0, 0.0])
"""How far a site is moved, m."""


def check_kind(kind: Kind, rig: Rig, seed: int = 0) -> Report:
    """What `kind_checks` find."""
    return report(kind_checks(kind, rig, seed))


def kind_checks(kind: Kind, rig: Rig, seed: int = 0) -> list[Check]:
    """The checks of a kind of measurement at positions among the anchors or stations of `rig`.

    `predicted` gives one finite number per column and row, row by row whatever the numbering of the sensors, and the
    same where a site is moved as a whole, since recordings in map coordinates are tracked about an origin nearby; the
    numbers fit what the kind declares; a recording of them is written, read and checked without an error. Raises
    UnusableInput for an object of another kind.
    """
    require_part("check_kind", kind)

    @cache
    def world() -> _World:
        return _World(kind, rig, seed)

    @cache
    def values() -> Float[np.ndarray, "N m"]:
        if kind.predicted is None:
            raise NotApplicable("positions do not predict the kind: predicted is None")
        return kind.values_at(world().positions, world().sensors())

    def check_values() -> str:
        bad = np.argwhere(~np.isfinite(values()))
        if len(bad):
            raise BrokenContract(
                f"kind {kind.name}: predicted gives {values()[tuple(bad[0])]} at "
                f"{world().positions[bad[0, 0]].round(2)} m, expected a finite number; usual fix: np.maximum around "
                "the argument of a root"
            )
        return f"{values().shape[1]} for each of {ROWS} readings, {values().min():.3g} to {values().max():.3g}"

    def check_rows() -> None:
        order, sensors = np.random.default_rng(seed).permutation(ROWS)[: ROWS // 2], world().sensors()
        mixed = kind.values_at(world().positions[order], sensors._replace(number=sensors.number[order]))
        _require_equal(
            kind, mixed, values()[order], "for half of the rows in another order", "no mean, sum or sort over rows"
        )

    def check_numbering() -> str | None:
        if not kind.sensors:
            return "no anchors or stations"
        other = kind.values_at(world().positions, world().sensors(world().ids[::-1]))
        fix = "the places of a reading are sensors.places[sensors.number[:, k]], as `sensors.distances` takes them"
        _require_equal(kind, other, values(), "in another numbering of the anchors or stations", fix)
        return None

    def check_moved() -> None:
        if kind.position:
            raise NotApplicable("the values are a position, which moves with the site")
        sensors = world().sensors()
        moved = kind.values_at(world().positions + SHIFT, sensors._replace(places=sensors.places + SHIFT))
        fix = "positions less sensors.places, as `sensors.distances` has it"
        _require_equal(kind, moved, values(), f"of the site moved by {SHIFT[:2].round()} m as a whole", fix)

    def check_declared() -> str:
        compared = {"difference"} if kind.difference else set()
        for column, name, each in zip(world().columns, world().names, values().T, strict=True):
            if column.positive:
                compared.add("positive")
                if each.min() <= 0:
                    raise BrokenContract(
                        f"kind {kind.name}: predicted {name} is {each.min():.3g} in a row, though the column is "
                        "positive; usual fix: leave positive=True out"
                    )
            if name.endswith("_rad") and column.bound < np.pi:
                compared.add("bound")
                if np.abs(each).max() > column.bound:
                    raise BrokenContract(
                        f"kind {kind.name}: predicted {name} is {np.abs(each).max():.3g}, beyond its bound "
                        f"{column.bound:.3g}; usual fix: radians, wrapped by np.arctan2"
                    )
        if kind.difference:
            first, second = (world().sensors().places[world().sensors().number[:, k]] for k in range(2))
            apart = np.linalg.norm(first - second, axis=1)
            over = np.abs(values()[:, 0]) - apart
            if over.max() > 1e-6:
                raise BrokenContract(
                    f"kind {kind.name}: a predicted difference exceeds the distance of its two anchors by "
                    f"{over.max():.3g} m; usual fix: leave difference=True out"
                )
        return f"as declared: {listed(sorted(compared))}" if compared else "no bound that predictions could exceed"

    def read_back() -> RecordingFolder:
        with _known(kind), tempfile.TemporaryDirectory() as scratch:
            write_recording(world().recording(wrapped(values(), world().names)), Path(scratch) / "recording")
            return read_recording(Path(scratch) / "recording")

    def check_file() -> None:
        read = read_back().tables[kind.name].select(world().names).to_numpy()
        _require_equal(
            kind,
            read,
            wrapped(values(), world().names),
            "after a recording is written and read",
            "columns in m, rad or m/s",
        )

    def check_recording() -> str:
        with _known(kind):
            found = check(read_back())
        errors = [one for one in found if one.level == "error"]
        if errors:
            raise BrokenContract(
                f"kind {kind.name}: `check` of a recording without any error of its readings says: {errors[0].where}: "
                f"{errors[0].message}; usual fix: bias, large and floor of its columns in their unit"
            )
        return f"{len(found)} results, none an error"

    begun = Check("values", check_values)
    rows = Check("rows", check_rows, begun)
    numbering = Check("numbering", check_numbering, rows)
    declared = Check("declared", check_declared, numbering)
    return [
        begun,
        rows,
        numbering,
        Check("moved site", check_moved, numbering),
        declared,
        Check("file", check_file, numbering),
        Check("recording", check_recording, declared),
    ]


class _World:
    """Readings of a kind along a closed path among the sensors of a rig."""

    def __init__(self, kind: Kind, rig: Rig, seed: int) -> None:
        self.kind, self.rig = kind, rig
        self.ids = list(kind.places(rig))
        k = len(kind.sensors)
        if len(self.ids) < k:
            raise BrokenContract(
                f"kind {kind.name}: the rig has {len(self.ids)} {kind.noun}s, expected {k} at least, one for each of "
                f"{listed(kind.sensors)}; usual fix: check it with a rig of a site that measures it"
            )
        rng = np.random.default_rng(seed)
        there = list(kind.places(rig).values())
        places = np.array(there) if there else np.array([[-4.0, -3.0, 0.0], [4.0, 3.0, 2.0]])
        middle, reach = places.mean(axis=0), np.maximum(np.ptp(places, axis=0) / 3, 0.5)
        turn = 2 * np.pi * np.arange(ROWS)[:, None] / ROWS + np.array([0.0, np.pi / 2, 1.0])
        self.positions = middle + reach * np.sin(turn)
        self.number = np.array([rng.choice(len(self.ids), k, replace=False) for _ in range(ROWS)]).reshape(ROWS, k)
        antennas = [len(s.antennas) for s in rig.stations.values() if s.antennas is not None]
        count = max(antennas, default=1) if kind.numbered else len(kind.columns)
        self.columns = [kind.columns[0 if kind.numbered else n] for n in range(count)]
        self.names = [c.name.replace("{n}", f"{n + 1}") for n, c in enumerate(self.columns)]

    def sensors(self, ids: list[str] | None = None) -> Sensors:
        """The sensors of the readings, numbered by `ids`."""
        order = ids or self.ids
        places = {key: n for n, key in enumerate(order)}
        number = np.array([places[key] for key in self.ids], int)[self.number] if self.ids else self.number
        return self.kind.sensors_of(self.rig, order, number, len(self.columns))

    def recording(self, values: Float[np.ndarray, "N m"]) -> RecordingFolder:
        """A recording of these values of one tag, with truth."""
        head = pl.DataFrame({"t_s": 0.1 * np.arange(ROWS), "tag": ["1"] * ROWS})
        ids = [pl.Series(name, np.array(self.ids)[self.number[:, j]]) for j, name in enumerate(self.kind.sensors)]
        columns = [pl.Series(name, x) for name, x in zip(self.names, values.T, strict=True)]
        truth = head.with_columns(*(pl.Series(f"{a}_m", self.positions[:, j]) for j, a in enumerate("xyz")))
        rig = replace(self.rig, tags={}, bodies={})
        return RecordingFolder("kind", None, rig, {self.kind.name: head.with_columns(*ids, *columns), "truth": truth})


@contextmanager
def _known(kind: Kind) -> Iterator[None]:
    """The kind among those that recordings are read with."""
    before = KINDS.get(kind.name)
    if before is None:
        add_kind(kind)
    KINDS[kind.name] = kind
    try:
        yield
    finally:
        if before is None:
            KINDS.pop(kind.name)
        else:
            KINDS[kind.name] = before


def _require_equal(kind: Kind, mine: np.ndarray, expected: np.ndarray, where: str, fix: str) -> None:
    off = np.abs(mine - expected)
    if not off.max() <= 1e-6:
        row, column = np.unravel_index(int(np.where(np.isnan(off), np.inf, off).argmax()), off.shape)
        raise BrokenContract(
            f"kind {kind.name}: value {column} of reading {row} is {mine[row, column]:.6g} {where}, expected "
            f"{expected[row, column]:.6g} as before; usual fix: {fix}"
        )
