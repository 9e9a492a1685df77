"""Eight antennas for the volume of Table 1: the default array, the best grid points, a minimum of the Cramér–Rao bound.

All three stations of the work stand have the same array, within the box of the default one (6 cm × 4 cm), with antennas
at least half a wavelength apart and side lobes no higher. The default array was fitted to Table 1 of Will et al. 2020,
not optimised. The layouts were searched beforehand (`fit`), by gradient from 64 random starts, and on a grid of 10 × 7
positions. The grid has 9·10⁹ layouts; from eight random ones, each antenna in turn is moved to the best free position.
No printed number was used. The study tests on the helix whether a lower bound improves tracking, by the 3-D errors of
the beacon.
"""

from __future__ import annotations

from collections.abc import Iterator

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import plot
from trackwright.experiments.lab.papers.fitting import Fitted
from trackwright.experiments.lab.questions import _designs as of
from trackwright.experiments.lab.questions._designs import LAYOUTS, SIGMA_P
from trackwright.experiments.pages.charts.style import VERMILION
from trackwright.sim.paths import WORK_VOLUME
from trackwright.sim.stations import simulate_phases, work_station
from trackwright.trackers.aoa.layout import DEFAULT_ANTENNAS
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.tuning.design import SearchResult, descend, exchange

DESIGNS = of.designs("array")
MAGNIFIED = 10.0
"""Scale of the array relative to the volume in the plot."""


def helices(ids: np.ndarray, seed: int, layout: str) -> RecordingFolder:
    """Phases along helices of the paper's size anywhere in the volume, for stations with the layout's array."""
    rig = work_station(DESIGNS[layout].positions)
    world = simulate_phases(rig, "varied-helix", ids, seed, sigma_p=SIGMA_P, rate_hz=10.0, n_points=200)
    return world.folder("work-stand")


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """Search by gradient against the grid, and errors of trackers against bounds."""
    default, _, gradient = (DESIGNS[layout] for layout in LAYOUTS)
    direct = of.rmse_ratio(results, "direct", "gradient")
    posterior = [results.value("bound_3d_m", layout, "direct").value for layout in LAYOUTS]
    ratio = posterior[2] / posterior[0]
    cascade = of.rmse_ratio(results, "cascade", "gradient")
    yield of.against_grid("array")
    yield mc.Conclusion(
        "the direct filter's RMSE decreases in proportion to its posterior bound, within 10 %",
        abs(direct.value / ratio - 1) < 0.10,
        f"ratio to the default array: RMSE {direct.value:.3f} [{direct.low:.3f}, {direct.high:.3f}], posterior bound "
        f"{ratio:.3f}, bound of an epoch {gradient.bound / default.bound:.3f}",
        mc.PREDICTED,
    )
    yield mc.Conclusion(
        "the cascade, for which the array was not designed, improves too",
        cascade.high < 1.0,
        f"ratio of the RMSE {cascade.value:.3f} [{cascade.low:.3f}, {cascade.high:.3f}]",
        mc.PREDICTED,
    )


def bounds(results: mc.Results, figure: Figure) -> None:
    """Map of the bound for each array, at half the height of the volume, with its magnified antennas."""
    low, high = WORK_VOLUME
    axes = np.linspace(low[0], high[0], 25), np.linspace(low[1], high[1], 25), (low[2] + high[2]) / 2

    def antennas(panel: Axes, design: of.Design) -> None:
        panel.plot(*(MAGNIFIED * design.positions.T), "o", color=VERMILION, markersize=5, markeredgecolor="white")

    title = f"Bound in the volume, and antennas magnified {MAGNIFIED:g} times"
    of.maps(of.stand(), DESIGNS, axes, antennas, title, False, figure)


STUDY = mc.Study(
    name="design-array",
    about="Which positions of eight antennas give the smallest errors in the work volume? Default, grid and gradient",
    worlds={layout: mc.World(helices, {"layout": layout}) for layout in LAYOUTS},
    trackers={
        "direct": mc.TrackerConfig("direct", {"sensors.*.sigma_p": SIGMA_P}),
        "cascade": mc.TrackerConfig("cascade", {"beams.*.sensors.*.sigma_p": SIGMA_P}),
    },
    runs=100,
    measures={"square_3d_m2": of.mean_square},
    metrics=("rmse_3d_m", "p95_3d_m", "bound_3d_m", "diverged"),
    expected=expected,
    draw=plot("arrays.svg", bounds, 7.0, 3.0),
)

STARTS, STEPS, RATE = 64, 150, 0.05
COLUMNS, ROWS, ROUNDS = 10, 7, 8


def fit() -> tuple[str, dict[str, Fitted]]:
    """Both searches, in double precision."""
    with jax.enable_x64(True):
        layout, rng = of.stand(), np.random.default_rng(0)
        objective = layout.objective(of.TOOL_POINTS)
        starts = rng.random((STARTS, *layout.shape))
        x, y = np.meshgrid(np.linspace(0, 1, COLUMNS), np.linspace(0, 1, ROWS), indexing="ij")
        choices = np.stack([x.ravel(), y.ravel()], axis=1)
        layouts = [rng.choice(len(choices), layout.shape[0], replace=False) for _ in range(ROUNDS)]
        searches = {
            "default": SearchResult(layout.theta(DEFAULT_ANTENNAS), 0.0, 0),
            "grid": exchange(objective, choices, layouts),
            "gradient": descend(objective, layout.project, starts, STEPS, RATE),
        }
        return of.searched(layout, of.TOOL_POINTS, searches)
