"""Eight antennas for the volume of Table 1: the default array, the best grid points, a minimum of the Cramér–Rao bound.

All three stations of the work stand have the same array, within the box of the default one (6 cm × 4 cm), with antennas
at least half a wavelength apart and side lobes no higher. The default array was fitted to Table 1 of Will et al. 2020,
not optimised. The layouts were found by `python -m experiments.lab.questions.fit_design_array`; no printed number was
used. The study tests on the helix whether a lower bound improves tracking, by the 3-D errors of the beacon.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from experiments.lab.questions._designs import (
    LAYOUTS,
    SIGMA_P,
    against_grid,
    bound_map,
    designs,
    maps,
    mean_square,
    rmse_ratio,
    stand,
)
from experiments.monte_carlo import PREDICTED, Conclusion, ExpectedResult, Results, Study, TrackerConfig, World
from experiments.pages.plots.style import VERMILION
from sim.paths import WORK_VOLUME
from sim.stations import simulate_phases, work_station
from trackers.recordings.folder import RecordingFolder

DESIGNS = designs("array")
MAGNIFIED = 10.0
"""Scale of the array relative to the volume in the plot."""


def helices(ids: np.ndarray, seed: int, layout: str) -> RecordingFolder:
    """Phases along helices of the paper's size anywhere in the volume, for stations with the layout's array."""
    rig = work_station(DESIGNS[layout].positions)
    world = simulate_phases(rig, "varied-helix", len(ids), seed, sigma_p=SIGMA_P, rate_hz=10.0, n_points=200, ids=ids)
    return world.folder("work-stand")


def expected(results: Results) -> list[ExpectedResult | Conclusion]:
    """Search by gradient against the grid, and errors of trackers against bounds."""
    default, _, gradient = (DESIGNS[layout] for layout in LAYOUTS)
    found = rmse_ratio(results, "direct", "gradient")
    posterior = [results.value("bound_3d_m", layout, "direct").value for layout in LAYOUTS]
    ratio = posterior[2] / posterior[0]
    cascade = rmse_ratio(results, "cascade", "gradient")
    return [
        against_grid("array"),
        Conclusion(
            "the direct filter's RMSE decreases in proportion to its posterior bound, within 10 %",
            abs(found.value / ratio - 1) < 0.10,
            f"ratio to the default array: RMSE {found.value:.3f} [{found.low:.3f}, {found.high:.3f}], posterior bound "
            f"{ratio:.3f}, bound of an epoch {gradient.bound / default.bound:.3f}",
            PREDICTED,
        ),
        Conclusion(
            "the cascade, for which the array was not designed, improves too",
            cascade.high < 1.0,
            f"ratio of the RMSE {cascade.value:.3f} [{cascade.low:.3f}, {cascade.high:.3f}]",
            PREDICTED,
        ),
    ]


def draw(results: Results, folder: Path) -> list[str]:
    """Map of the bound for each array, at half the height of the volume, with its magnified antennas."""
    low, high = WORK_VOLUME
    x, y = (np.linspace(low[k], high[k], 25) for k in (0, 1))
    points = np.stack([a.ravel() for a in np.meshgrid(x, y, [(low[2] + high[2]) / 2], indexing="ij")], axis=1)
    layout = stand()
    fields = {
        name: bound_map(layout, layout.theta(design.positions), points).reshape(len(x), len(y))
        for name, design in DESIGNS.items()
    }

    def antennas(axes: Axes, name: str) -> None:
        axes.plot(*(MAGNIFIED * DESIGNS[name].positions.T), "o", color=VERMILION, markersize=5, markeredgecolor="white")

    return [
        maps(
            folder,
            "arrays.svg",
            fields,
            x,
            y,
            antennas,
            f"Bound in the volume, and antennas magnified {MAGNIFIED:g} times",
        )
    ]


STUDY = Study(
    name="design-array",
    about="Which positions of eight antennas give the smallest errors in the work volume? Default, grid and gradient",
    worlds={layout: World(helices, {"layout": layout}) for layout in LAYOUTS},
    trackers={
        "direct": TrackerConfig("direct", {"sensors.*.sigma_p": SIGMA_P}),
        "cascade": TrackerConfig("cascade", {"beams.*.sensors.*.sigma_p": SIGMA_P}),
    },
    runs=100,
    measures={"square_3d_m2": mean_square},
    metrics=("rmse_3d_m", "p95_3d_m", "bound_3d_m", "diverged"),
    expected=expected,
    draw=draw,
)
