"""Table 2 of Kwon et al. 2021: largest deviations of a tag at rest in an anechoic chamber, the mean over four corners.

The anchors are 5 m apart; their positions are not printed. Right above the tags they would make z as accurate as x and
y; their square is therefore turned by 15°, the best of 0°, 15°, 30° and 45° for the heights of Table 3 (`robot`).
"""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import CONSTANT_BIASES, Printed
from trackwright.experiments.lab.papers.fitting import Fit, Fitted, fitted
from trackwright.experiments.text.expectations import listed
from trackwright.sim.corruptions import antenna_biases
from trackwright.sim.ranging import Protocol, RangeDraw, chamber
from trackwright.trackers.recordings.folder import RecordingFolder

PLACES = {f"tag at ({x:g}, {y:g})": (x, y, 1.8) for x in (0.0, 5.0) for y in (0.0, 5.0)}
SIDE, TURN = 5.0, np.deg2rad(15.0)  # side of the anchors' square, m, and its angle to the tags' square, rad

PROTOCOL = Protocol(sigma_stamp=fitted("papers/kwon_2021/table_4")["sigma_stamp"])
ROWS = 100
_of = partial(Printed, unit="mm", worlds=tuple(PLACES), tracker="least squares")
_LARGEST = "Table 2, largest deviation in {}, mean over four places"
PRINTED = {
    "x": _of(_LARGEST.format("x"), 55.75, "largest_x_m", mc.FITTED),
    "y": _of(_LARGEST.format("y"), 57.0, "largest_y_m", mc.DERIVED, "follows from x by the symmetry of the room"),
    "z": _of(_LARGEST.format("z"), 144.25, "largest_z_m", mc.FITTED),
}


def anchors(height: float) -> np.ndarray:
    """Anchors (4, 3), m, at `height`, m, around the centre of the tags' square."""
    angles = TURN + np.pi / 4 + np.pi / 2 * np.arange(4)
    around = SIDE / np.sqrt(2) * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.column_stack([2.5 + around, np.full(4, height)])


def corner(
    ids: np.ndarray, seed: int, place: tuple[float, float, float], sigma_bias: float, height: float
) -> RecordingFolder:
    """Tags at rest at `place`, m; anchors at `height`, m, with normal biases of `sigma_bias`, m."""
    draw = RangeDraw(
        chamber(anchors(height)), lambda keys, times: np.tile(np.asarray(place, float), (len(keys), len(times), 1)),
        {"biases": antenna_biases(sigma_bias)}, n_points=ROWS, protocol=PROTOCOL,
    )  # fmt: skip
    return draw.drawn(ids, seed).folder("chamber")


def under(z: np.ndarray, folder: RecordingFolder) -> np.ndarray:
    """Heights, m, mirrored to below the anchors' plane, in which a tag and its mirror image are indistinguishable."""
    plane = next(iter(folder.rig.anchors.values()))[2]
    return plane - np.abs(z - plane)


def deviations(tracked: mc.TrackedRuns) -> np.ndarray:
    """Errors (n, T, 3), m, of each axis, with heights above the anchors mirrored; NaN without an estimate."""
    mirrored = tracked.estimates.copy()
    mirrored[..., 2] = under(mirrored[..., 2], tracked.folder)
    return tracked._replace(estimates=mirrored).error


def _largest(axis: int) -> Callable[[mc.TrackedRuns], np.ndarray]:
    return lambda tracked: np.nanmax(np.abs(deviations(tracked)[..., axis]), axis=1)


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """Table 2."""
    yield from (figure.beside(results) for figure in PRINTED.values())
    ours = {axis: figure.ours(results) for axis, figure in PRINTED.items()}
    larger = ours["z"].low > max(ours["x"].high, ours["y"].high)
    yield mc.Conclusion("errors in z are larger than in x and y", larger, listed(ours, "{:.0f} mm"), mc.DERIVED)


NUMBERS = fitted("papers/kwon_2021/chamber")
STUDY = mc.Study(
    name="chamber",
    about="Table 2 of Kwon et al. 2021: the largest deviations of a still tag in a chamber",
    worlds={name: mc.World(corner, {"place": place, **NUMBERS}) for name, place in PLACES.items()},
    trackers={
        "least squares": mc.TrackerConfig("multilateration", free_height=True),
        "filter": mc.TrackerConfig("uwb", CONSTANT_BIASES, free_height=True),
    },
    runs=200,
    seed=1,
    measures={f"largest_{axis}_m": _largest(k) for k, axis in enumerate("xyz")},
    metrics=("largest_x_m", "largest_y_m", "largest_z_m", "rmse_m"),
    expected=expected,
)

fit = Fit(
    STUDY,
    {"sigma_bias": Fitted(0.05, "m", "x"), "height": Fitted(2.45, "m", "z")},
    [[PRINTED["x"]], [PRINTED["z"]]],
    "1 of 3 printed figures: y",
    runs=100,
)
