"""What declarations of studies share: printed numbers as data, and plots."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.pages.plots.style import HEIGHT, WIDTH, write_svg

UNITS = {"cm": 100.0, "mm": 1e3, "cm²": 1e4, "deg": 180 / np.pi, "%": 100.0}
"""Factors from SI units and from fractions."""


@dataclass(frozen=True)
class Printed:
    """A number that a paper prints in `unit`, and what of a study is compared with it.

    `metric`: a metric or measure; of several `worlds` its mean. The rest as of `ExpectedResult`. What the numbers of a
    table have in common is given by keyword, once, by `functools.partial`.
    """

    quantity: str
    number: float
    metric: str
    origin: mc.Origin
    note: str = ""
    _: KW_ONLY
    unit: str
    worlds: tuple[str, ...]
    tracker: str

    def ours(self, results: mc.Results, **point: float) -> mc.Value:
        """The study's own number, in the same unit."""
        pairs = [(world, self.tracker) for world in self.worlds]
        return results.average(self.metric, pairs, **point).times(UNITS[self.unit])

    def beside(self, results: mc.Results, note: str = "", **point: float) -> mc.ExpectedResult:
        """The printed number beside the study's own; `note`: in place of the declared one."""
        share, ours = self.unit == "%", self.ours(results, **point)
        return mc.ExpectedResult(
            self.quantity, self.number, ours, self.unit, self.origin, note=note or self.note, share=share
        )


def plot(
    name: str, panels: Callable[[mc.Results, Figure], None], width: float = WIDTH, height: float = HEIGHT
) -> Callable[[mc.Results, Path], list[str]]:
    """The `draw` of a study with one figure, drawn by `panels(results, figure)`; sizes in inches."""
    return lambda results, folder: [write_svg(folder, name, partial(panels, results), width, height)]
