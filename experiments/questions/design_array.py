"""Eight antennas for the volume of Table 1: the default array, a grid's, and where the gradient of the bound puts them.

All three stations of the work stand have the same array, in the box of the default one (6 cm × 4 cm), antennas half a
wavelength apart, with no higher side lobes. The default is fitted to the paper's Table 1, no attempt at a good one. The
layouts are those of `python -m experiments.questions.fit_design_array`: nothing printed was used. Whether a lower bound
makes a better tracker is seen on the helix, as the beacon's errors in space.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from experiments.monte_carlo.declaration import Study, TrackerConfig, World
from experiments.monte_carlo.expectations import Conclusion, ExpectedResult
from experiments.monte_carlo.results import Results
from experiments.plots.style import VERMILION
from experiments.questions._design_pictures import maps
from experiments.questions._designs import LAYOUTS, SIGMA_P, against_grid, bound_map, designs, fall, squares, stand
from sim.paths import WORK_VOLUME
from sim.stations import simulate_phases, work_station
from trackers.recordings.folder import RecordingFolder

DESIGNS = designs("array")
MAGNIFIED = 10.0
"""Times by which the array is drawn larger than the volume under it."""


def helices(ids: np.ndarray, seed: int, layout: str) -> RecordingFolder:
    """Helices of the paper's size anywhere in the volume, phases of stations with the layout's array."""
    rig = work_station(DESIGNS[layout].places)
    world = simulate_phases(rig, "varied-helix", len(ids), seed, sigma_p=SIGMA_P, rate_hz=10.0, n_points=200, ids=ids)
    return world.folder("work-stand")


def expected(results: Results) -> list[ExpectedResult | Conclusion]:
    """The gradient against the grid, and tracks against bounds."""
    usual, grid, gradient = (DESIGNS[layout] for layout in LAYOUTS)
    found = fall(results, "direct", "gradient")
    posterior = [results.value("bound_3d_m", layout, "direct").value for layout in LAYOUTS]
    ratio = posterior[2] / posterior[0]
    through = fall(results, "cascade", "gradient")
    return [
        against_grid(usual, grid, gradient),
        Conclusion(
            "the direct filter's RMSE falls as its posterior bound does, within 10 %",
            abs(found.value / ratio - 1) < 0.10,
            f"RMSE to {found.value:.3f} [{found.low:.3f}, {found.high:.3f}] of that with the default array, posterior "
            f"bound to {ratio:.3f}, bound of an epoch to {gradient.bound / usual.bound:.3f}",
        ),
        Conclusion(
            "the cascade, for which the array was not laid out, gains too",
            through.high < 1.0,
            f"RMSE to {through.value:.3f} [{through.low:.3f}, {through.high:.3f}]",
        ),
    ]


def draw(results: Results, folder: Path) -> list[str]:
    """The three arrays, magnified, over a map of their bounds half-way up the volume."""
    low, high = WORK_VOLUME
    x, y = (np.linspace(low[k], high[k], 25) for k in (0, 1))
    points = np.stack([a.ravel() for a in np.meshgrid(x, y, [(low[2] + high[2]) / 2], indexing="ij")], axis=1)
    layout = stand()
    fields = {
        name: bound_map(layout, layout.theta(design.places), points).reshape(len(x), len(y))
        for name, design in DESIGNS.items()
    }

    def antennas(axes: Axes, name: str) -> None:
        axes.plot(*(MAGNIFIED * DESIGNS[name].places.T), "o", color=VERMILION, markersize=5, markeredgecolor="white")

    return [
        maps(
            folder,
            "arrays.svg",
            fields,
            x,
            y,
            antennas,
            f"Bound in the volume, and antennas {MAGNIFIED:g} times as large",
        )
    ]


STUDY = Study(
    name="design-array",
    about="Where eight antennas must stand for the least error in the work volume, by their bounds and on tracks",
    worlds={layout: World(helices, {"layout": layout}) for layout in LAYOUTS},
    trackers={
        "direct": TrackerConfig("direct", {"sensors.*.sigma_p": SIGMA_P}),
        "cascade": TrackerConfig("cascade", {"beams.*.sensors.*.sigma_p": SIGMA_P}),
    },
    runs=100,
    measures={"square_3d_m2": squares},
    metrics=("rmse_3d_m", "p95_3d_m", "bound_3d_m", "diverged"),
    expected=expected,
    draw=draw,
)
