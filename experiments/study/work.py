"""Carrying a study out: what is missing of its chunks, on all devices, until figures are known well enough."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.errors import UnusableInput
from experiments.screen import Advance
from experiments.study.declaration import Cell, Study
from experiments.study.results import NAMES, Results
from experiments.study.run import devices, trajectories
from experiments.study.store import Store
from experiments.study.tally import BINS

TOGETHER = 2
"""Neighbouring chunks that one shard takes, so that two devices have work."""


@dataclass(frozen=True)
class Until:
    """A figure and the half width of its interval, relative to it, at which a cell has runs enough."""

    figure: str
    share: float

    @classmethod
    def parsed(cls, text: str, study: Study) -> Until:
        """From text as `rmse_m±1%`; raises UnusableInput for other text."""
        found = re.fullmatch(r"\s*(\w+)\s*(?:±|\+-|\+/-)\s*([0-9.]+)\s*%\s*", text)
        known = (*NAMES, *study.measures)
        if found is None or found[1] not in known or not 0 < float(found[2]) < 100:
            raise UnusableInput(
                f'--until "{text}": expected a figure and a width, as "rmse_m±1%"; figures: {", ".join(known)}'
            )
        return cls(found[1], float(found[2]) / 100)

    def reached(self, results: Results, cell: Cell) -> bool:
        """Whether the figure is known so well for every tracker that has it."""
        for tracker in results.study.trackers:
            value = results.at(self.figure, cell, tracker)
            if np.isfinite(value.value) and value.high - value.low > 2 * self.share * abs(value.value):
                return False
        return True


def carry_out(
    study: Study, folder: Path, shard: tuple[int, int], until: Until | None, advance: Advance
) -> Results | None:
    """Run what is missing; the figures, or None where chunks of other shards are missing still.

    With `until` a cell ends after 1, 2, 4, 8 … chunks, as soon as its figure is known well enough, however many devices
    there are. Raises UnusableInput where the folder holds another study, and where `until` is asked of a shard.
    """
    if until is not None and shard != (1, 1):
        raise UnusableInput("--until with --shard: a shard doesn't see the others' runs; leave one of them out")
    store = Store(folder, study).opened()
    runs = {}
    for cell in study.cells:
        if until is None:
            _complete(store, cell, _mine(study, cell, shard), advance)
            runs[cell.index] = study.runs
        else:
            runs[cell.index] = _run_until(store, cell, until, advance)
    whole = all(store.has(cell, k) for cell, n in runs.items() for k in range(-(-n // study.chunk)))
    return store.results(runs) if whole else None


def _mine(study: Study, cell: Cell, shard: tuple[int, int]) -> list[int]:
    """The chunks of a cell that a shard, i of n, runs."""
    first = cell.index * -(-study.chunks // TOGETHER)
    return [k for k in range(study.chunks) if (first + k // TOGETHER) % shard[1] == shard[0] - 1]


def _run_until(store: Store, cell: Cell, until: Until, advance: Advance) -> int:
    study, enough = store.study, 1
    while True:
        _complete(store, cell, list(range(min(enough, study.chunks))), advance)
        runs = min(enough * study.chunk, study.runs)
        if runs == study.runs or until.reached(store.results({cell.index: runs}), cell):
            advance(study.chunks - min(enough, study.chunks))
            return runs
        enough *= 2


def _complete(store: Store, cell: Cell, chunks: list[int], advance: Advance) -> None:
    """Run those of the chunks that aren't there yet, as many together as there are devices."""
    study = store.study
    missing = [k for k in chunks if not store.has(cell.index, k)]
    advance(len(chunks) - len(missing))
    while missing:
        together = [missing.pop(0)]
        while missing and len(together) < devices() and missing[0] == together[-1] + 1 and together[0] > 0:
            together.append(missing.pop(0))
        # A first chunk is alone: its bounds are averages over itself.
        ids = np.arange(together[0] * study.chunk, (together[-1] + 1) * study.chunk)
        kept = trajectories(study, cell, ids, first=together[0] == 0)
        for place, k in enumerate(together):
            part = slice(place * study.chunk, (place + 1) * study.chunk)
            store.put(cell.index, k, [_part_of(own, part) for own in kept])
        advance(len(together), cell.label)


def _part_of(own: dict[str, np.ndarray], part: slice) -> dict[str, np.ndarray]:
    """What was kept of some of the trajectories."""
    made: dict[str, np.ndarray] = {}
    for name, values in own.items():
        kind = name.partition(" ")[2]
        if name.startswith("cells "):
            mine = (values // BINS >= part.start) & (values // BINS < part.stop)
            made[name] = values[mine] - part.start * BINS
            made[f"counts {kind}"] = own[f"counts {kind}"][mine]
        elif not name.startswith("counts "):
            made[name] = values[part] if values.ndim and name != "bounds" else values
    return made
