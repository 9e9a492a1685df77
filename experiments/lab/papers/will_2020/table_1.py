"""Table 1 of paper A: errors of the beam tracker on the helix with five sets of antennas.

Fitted (`fit_table_1`): positions of the eight antennas and the phase noise, seventeen parameters to the table's ten
errors; the filter's process noise and the rate are chosen. No degree of freedom is left: the table shows that the
system can have these errors, not that it must. The simulated noise differs from the fit's. The order of the antenna
sets follows from the ten errors and is no prediction either. Predictions: `figures_6_7`, `figure_8`, `figure_10`,
`rate_aperture`.

The filter runs in its default form and in the paper's, which wraps each of the 28 differences (8)-(17).
"""

from __future__ import annotations

import numpy as np

from experiments.lab.papers.will_2020._work_stand import ALL, PRINTED_FORM, SETS, beam, recorded
from experiments.lab.papers.will_2020.fit_figure_8 import radius
from experiments.lab.papers.will_2020.fit_table_1 import PRINTED
from experiments.monte_carlo import FITTED, Conclusion, ExpectedResult, Results, Study, Value, World, inherited

DEGREES = 180 / np.pi
AXES = ("azimuth", "elevation")


def expected(results: Results) -> list[ExpectedResult | Conclusion]:
    """The ten errors of the table, and the paper's conclusions."""
    made: list[ExpectedResult | Conclusion] = []
    for name in SETS:
        for axis, printed in zip(AXES, PRINTED[name], strict=True):
            wrapped = _error(results, name, axis, "EKF, each difference wrapped")
            note = f"with each of the 28 differences wrapped, as printed: {wrapped.value:.3f} deg"
            made.append(
                ExpectedResult(
                    f"Table 1, {name}, {axis}", printed, _error(results, name, axis), "deg", FITTED, note=note
                )
            )
    return made + _conclusions(results)


def _error(results: Results, name: str, axis: str, tracker: str = "EKF") -> Value:
    return results.value(f"rmse_{axis}_rad", name, tracker).times(DEGREES)


def _conclusions(results: Results) -> list[ExpectedResult | Conclusion]:
    ours = {axis: {name: _error(results, name, axis) for name in SETS} for axis in AXES}
    made: list[ExpectedResult | Conclusion] = []
    for k, axis in enumerate(AXES):
        order = sorted(SETS, key=lambda name: ours[axis][name].value)
        printed = sorted(SETS, key=lambda name: PRINTED[name][k])
        told = ", ".join(f"{name} {ours[axis][name].value:.2f}" for name in order)
        text = f"{axis}: {printed[0]} is best and {printed[-1]} worst, with the others in the printed order between"
        made.append(Conclusion(text, order == printed, f"{told} deg", inherited(FITTED)))
    loss = max(ours[axis]["2-3-6"].value / ours[axis][ALL].value for axis in AXES)
    poor = min(max(ours[axis][name].value / ours[axis][ALL].value for axis in AXES) for name in SETS[:3])
    made.append(
        Conclusion(
            "the three outermost antennas alone are only slightly worse than all eight",
            loss < 1.25,
            f"at most {100 * (loss - 1):.0f} % worse in an angle, every small aperture {poor:.1f} times and more",
            inherited(FITTED),
        )
    )
    full = ours["azimuth"][ALL], ours["elevation"][ALL]
    made.append(
        Conclusion(
            "with all antennas both errors are under one degree, the azimuth's smaller, whose aperture is larger",
            full[0].high < full[1].low and full[1].high < 1.0,
            f"azimuth {full[0].value:.2f} deg, elevation {full[1].value:.2f} deg",
            inherited(FITTED),
        )
    )
    return made


STUDY = Study(
    name="table-1",
    about="How well do five sets of antennas follow azimuth and elevation of a beacon?",
    worlds={name: World(recorded, {"antennas": name, "radius": radius()}) for name in SETS},
    trackers={"EKF": beam(), "EKF, each difference wrapped": beam(PRINTED_FORM)},
    metrics=("rmse_azimuth_rad", "rmse_elevation_rad", "p95_direction_rad", "diverged", "nis_ratio"),
    expected=expected,
)
