"""Numbers that a paper doesn't print, fitted to some that it does: how they are found, written down and read."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.monte_carlo.chunk import run_chunk
from experiments.monte_carlo.declaration import Study
from trackers.recordings.atomic import atomic_write

EXPERIMENTS = Path(__file__).parents[1]
STEP = 0.05


class Fitted(NamedTuple):
    """A number found by a fit: value, unit, and the printed figures that it was fitted to."""

    value: float
    unit: str
    to: str


def fitted(name: str) -> dict[str, float]:
    """The numbers of a fit by its name, `will_2020/table_1`."""
    content = tomllib.loads(fitted_file(name).read_text("utf-8"))
    return {number: table["value"] for number, table in content["numbers"].items()}


def fitted_file(name: str) -> Path:
    """The file of a fit's numbers: `will_2020/table_1` is papers/will_2020/fitted/table_1.toml."""
    folder, _, stem = name.rpartition("/")
    home = EXPERIMENTS / folder if folder == "questions" else EXPERIMENTS / "papers" / folder
    return home / "fitted" / f"{stem}.toml"


def write_fitted(name: str, free: str, numbers: Mapping[str, Fitted]) -> Path:
    """Write what the fit of that name found; `free`: how many printed figures it left alone."""
    folder, _, stem = name.rpartition("/")
    package = folder if folder == "questions" else f"papers.{folder}"
    lines = [
        f"# Written by `python -m experiments.{package}.fit_{stem}`.",
        f"degrees_of_freedom_left = {json.dumps(free, ensure_ascii=False)}",
    ]
    for number, (value, unit, to) in numbers.items():
        lines += [
            "",
            f"[numbers.{number}]",
            f"value = {float(f'{value:.4g}')!r}",
            f'unit = "{unit}"',
            f"fitted_to = {json.dumps(to, ensure_ascii=False)}",
        ]
    text = "\n".join(lines) + "\n"
    return atomic_write(fitted_file(name), lambda temporary: temporary.write_text(text, encoding="utf-8"))


def solved(
    ratios: Callable[[np.ndarray], np.ndarray], start: Sequence[float], rounds: int = 6, farthest: float = 0.5
) -> np.ndarray:
    """The positive numbers (k,) at which all `ratios` (m,) of found to printed figures are as near one as can be.

    Gauss–Newton on logarithms with one-sided differences, no step beyond `farthest`; least squares where m > k. The
    figures come of seeded runs, so that they are smooth enough.
    """
    logs = np.log(np.asarray(start, float))
    for _ in range(rounds):
        here = np.log(ratios(np.exp(logs)))
        slopes = [(np.log(ratios(np.exp(logs + d))) - here) / STEP for d in STEP * np.eye(len(logs))]
        step = -np.linalg.lstsq(np.stack(slopes, axis=1), here, rcond=None)[0]
        logs = logs + np.clip(step, -farthest, farthest)
        if np.abs(step).max() < 1e-3:
            break
    return np.exp(logs)


def means(study: Study, runs: int) -> dict[tuple[str, str], dict[str, float]]:
    """The measures' means of a few trajectories: (world, tracker) -> measure -> mean; of the grid's last point."""
    found = {}
    for condition in study.conditions:
        kept = run_chunk(study, condition, np.arange(runs), first=False)
        for tracker, arrays in zip(study.trackers, kept, strict=True):
            found[condition.world, tracker] = {
                name.removeprefix("measure "): float(np.nanmean(values))
                for name, values in arrays.items()
                if name.startswith("measure ")
            }
    return found
