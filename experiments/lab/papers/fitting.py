"""Parameters that a paper does not print, fitted to results that it does: fitting, writing and reading them."""

from __future__ import annotations

import tempfile
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tomli_w
from scipy.optimize import least_squares

from experiments.monte_carlo import Results, Study, run_study
from experiments.monte_carlo.chunk import run_chunk
from trackers.recordings.atomic import atomic_write

LAB = Path(__file__).parents[1]
STEP = 0.05
"""Of the forward differences by log parameters."""


class Fitted(NamedTuple):
    """A fitted parameter: value, unit, and the printed results it was fitted to."""

    value: float
    unit: str
    to: str


def fitted(name: str) -> dict[str, float]:
    """The parameters of a fit by its name, such as `will_2020/table_1`."""
    content = tomllib.loads(fitted_file(name).read_text("utf-8"))
    return {number: table["value"] for number, table in content["numbers"].items()}


def fitted_file(name: str) -> Path:
    """The file of a fit: `will_2020/table_1` is papers/will_2020/fitted/table_1.toml."""
    folder, _, stem = name.rpartition("/")
    home = LAB / folder if folder == "questions" else LAB / "papers" / folder
    return home / "fitted" / f"{stem}.toml"


def write_fitted(name: str, free: str, numbers: Mapping[str, Fitted]) -> Path:
    """Write the parameters of a fit, to four digits; `free`: the degrees of freedom left, in words."""
    folder, _, stem = name.rpartition("/")
    package = folder if folder == "questions" else f"papers.{folder}"
    table = {
        "degrees_of_freedom_left": free,
        "numbers": {
            number: {"value": float(f"{value:.4g}"), "unit": unit, "fitted_to": to}
            for number, (value, unit, to) in numbers.items()
        },
    }
    text = f"# Written by `python -m experiments.{package}.fit_{stem}`.\n{tomli_w.dumps(table)}"
    return atomic_write(fitted_file(name), lambda temporary: temporary.write_text(text, encoding="utf-8"))


def solved(
    ratios: Callable[[dict[str, float]], np.ndarray], start: Mapping[str, float], rounds: int = 6
) -> dict[str, float]:
    """The positive parameters at which the `ratios` (m,) of simulated to printed results are closest to one.

    Least squares of the ratios' logarithms over the parameters' logarithms, with forward differences over 5 %, until a
    step is below a thousandth or after `rounds` steps. Seeded runs make the ratios smooth functions of the parameters.
    """

    def numbers(shifted: np.ndarray) -> dict[str, float]:
        return dict(zip(start, (begin * np.exp(shifted - 1.0)).tolist(), strict=True))

    # Log parameters are shifted to one at the start, so that the relative step of the differences is STEP.
    begin = np.array(list(start.values()), float)
    found = least_squares(
        lambda x: np.log(ratios(numbers(x))), np.ones(len(begin)), diff_step=STEP, xtol=1e-3, max_nfev=rounds + 1
    )
    return numbers(found.x)


def unsaved(study: Study) -> Results:
    """The results of a study whose chunks are not kept."""
    with tempfile.TemporaryDirectory() as folder:
        results = run_study(study, Path(folder))
    assert results is not None
    return results


def means(study: Study, runs: int, tracker: str | None = None) -> dict[tuple[str, str], dict[str, float]]:
    """Means of the measures over `runs` trajectories, by (world, tracker) and measure, at the grid's last point.

    Of one tracker, or of all if none is named.
    """
    if tracker is not None:
        study = replace(study, trackers={tracker: study.trackers[tracker]})
    found = {}
    for condition in study.conditions:
        kept = run_chunk(study, condition, np.arange(runs), first=False)
        for name, arrays in zip(study.trackers, kept, strict=True):
            found[condition.world, name] = {
                key.removeprefix("measure "): float(np.nanmean(values))
                for key, values in arrays.items()
                if key.startswith("measure ")
            }
    return found
