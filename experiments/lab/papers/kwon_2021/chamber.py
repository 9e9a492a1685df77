"""Table 2 of Kwon et al. 2021: largest deviations of the estimates of a tag at rest in an anechoic chamber.

The mean over four tags in the corners of a square of 5 m. The anchors are 5 m apart; their positions are not printed.
Anchors right above the tags would make z as accurate as x and y; their square is therefore turned by 15°, the best of
0°, 15°, 30° and 45° for the heights of Table 3 (`robot`). The noise of a time stamp is that of `table-4`. Fitted to
Table 2: the spread of the anchors' biases to x, the anchors' height to z. Derived: y, from x by the symmetry of the
room.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from experiments.lab.papers.constant_biases import CONSTANT_BIASES
from experiments.lab.papers.fitting import fitted
from experiments.monte_carlo import (
    DERIVED,
    FITTED,
    Conclusion,
    ExpectedResult,
    Results,
    Study,
    TrackedRuns,
    TrackerConfig,
    World,
    inherited,
)
from experiments.text.wording import listed
from sim.ranging import Protocol, antenna_biases, chamber, simulate_ranges
from trackers.recordings.folder import RecordingFolder

PLACES = {f"tag at ({x:g}, {y:g})": (x, y, 1.8) for x in (0.0, 5.0) for y in (0.0, 5.0)}
SIDE, TURN = 5.0, np.deg2rad(15.0)
"""Side of the anchors' square, m, and its angle to the tags' square, rad."""

ROWS = 100
PRINTED_MM = {"x": 55.75, "y": 57.0, "z": 144.25}


def anchors(height: float) -> np.ndarray:
    """Anchors (4, 3), m, at `height`, m, around the centre of the tags' square."""
    angles = TURN + np.pi / 4 + np.pi / 2 * np.arange(4)
    around = SIDE / np.sqrt(2) * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.column_stack([2.5 + around, np.full(4, height)])


def corner(
    ids: np.ndarray, seed: int, place: tuple[float, float, float], sigma_bias: float, height: float
) -> RecordingFolder:
    """Tags at rest at `place`, m; anchors at `height`, m, with normal biases of `sigma_bias`, m."""
    world = simulate_ranges(
        chamber(anchors(height)),
        lambda keys, times: np.tile(np.asarray(place, float), (len(keys), len(times), 1)),
        len(ids),
        seed,
        n_points=ROWS,
        protocol=Protocol(sigma_stamp=fitted("kwon_2021/table_4")["sigma_stamp"]),
        corruptions={"biases": antenna_biases(sigma_bias)},
        ids=ids,
    )
    return world.folder("chamber")


def under(z: np.ndarray, folder: RecordingFolder) -> np.ndarray:
    """Heights, m, mirrored to below the anchors' plane, in which a tag and its mirror image are indistinguishable."""
    plane = next(iter(folder.rig.anchors.values()))[2]
    return plane - np.abs(z - plane)


def deviations(tracked: TrackedRuns) -> np.ndarray:
    """Errors (n, T, 3), m, of each axis, with heights above the anchors mirrored; NaN without an estimate."""
    found = tracked.estimates.copy()
    found[..., 2] = under(found[..., 2], tracked.folder)
    return tracked._replace(estimates=found).error


def _largest(axis: int) -> Callable[[TrackedRuns], np.ndarray]:
    return lambda tracked: np.nanmax(np.abs(deviations(tracked)[..., axis]), axis=1)


def expected(results: Results) -> list[ExpectedResult | Conclusion]:
    """Table 2."""
    found: list[ExpectedResult | Conclusion] = []
    ours = {a: results.average(f"largest_{a}_m", [(w, TRACKER) for w in PLACES]).times(1e3) for a in PRINTED_MM}
    for axis, printed in PRINTED_MM.items():
        claim = f"Table 2, largest deviation in {axis}, mean over four places"
        found.append(
            ExpectedResult(claim, printed, ours[axis], "mm", DERIVED, note="follows from x by the symmetry of the room")
            if axis == "y"
            else ExpectedResult(claim, printed, ours[axis], "mm", FITTED)
        )
    larger = ours["z"].low > max(ours["x"].high, ours["y"].high)
    says = "errors in z are larger than in x and y"
    return [*found, Conclusion(says, larger, listed(ours, "{:.0f} mm"), inherited(FITTED, DERIVED))]


TRACKER = "least squares"


def study_with(numbers: dict[str, float], runs: int = 200, seed: int = 1) -> Study:
    """The study with these parameters of the chamber; its seed differs from the fit's, 0."""
    return Study(
        name="chamber",
        about="Table 2 of Kwon et al. 2021: the largest deviations of a still tag in a chamber",
        worlds={name: World(corner, {"place": place, **numbers}) for name, place in PLACES.items()},
        trackers={
            TRACKER: TrackerConfig("multilateration", free_height=True),
            "filter": TrackerConfig("uwb", CONSTANT_BIASES, free_height=True),
        },
        runs=runs,
        seed=seed,
        measures={f"largest_{axis}_m": _largest(k) for k, axis in enumerate("xyz")},
        metrics=("largest_x_m", "largest_y_m", "largest_z_m", "rmse_m"),
        expected=expected,
    )


STUDY = study_with(fitted("kwon_2021/chamber"))
