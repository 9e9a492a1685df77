"""Table 1 of Kwon et al. 2021: errors of tags at rest with and without line of sight to three anchors.

Largest and smallest error over sixteen positions in sight, and over four where an obstacle hides an anchor, whose
printed minimum and maximum are exchanged (289 is above −382). Assumed are three anchors at a right angle, the one along
x hidden. Fitted: the spread of the range errors, constant at each position, and the detour round the obstacle.
"""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import Printed
from trackwright.experiments.lab.papers.fitting import Fit, Fitted, fitted
from trackwright.experiments.lab.papers.kwon_2021.chamber import PROTOCOL
from trackwright.experiments.text.expectations import listed
from trackwright.sim.corruptions import Corruption, gauss_markov, obstruction, on_anchors
from trackwright.sim.ranging import RangeDraw, chamber
from trackwright.trackers.recordings.folder import RecordingFolder

HALL = np.array([[0.0, 0.0, 1.8], [8.0, 0.0, 1.8], [0.0, 8.0, 1.8]])
HIDDEN = (1,)
REPEATS = 20
TRACKER = "trilateration"
_of = partial(Printed, unit="mm", tracker=TRACKER)
_SPAN = "Table 1, {}, {}, largest less smallest"
PRINTED = (
    _of(_SPAN.format("in sight", "x"), 195 + 194, "span_x_m", mc.FITTED, worlds=("in sight",)),
    _of(_SPAN.format("in sight", "y"), 188 + 194, "span_y_m", mc.FITTED, worlds=("in sight",)),
    _of(_SPAN.format("hidden", "x"), 289 + 382, "span_x_m", mc.FITTED, worlds=("hidden",)),
    _of(_SPAN.format("hidden", "y"), 107 + 237, "span_y_m", mc.PREDICTED, worlds=("hidden",)),
)


def hall(ids: np.ndarray, seed: int, places: int, sigma_echo: float, detour: float = 0.0) -> RecordingFolder:
    """Tags that visit a square grid of `places` positions; `detour`, m, is added to ranges of the hidden anchor."""
    side = round(places**0.5)
    spots = np.stack(np.meshgrid(np.linspace(1.0, 3.0, side), np.linspace(1.0, 3.0, side)), -1).reshape(-1, 2)
    stops = np.column_stack([spots, np.full(places, 1.2)]).repeat(REPEATS, axis=0)
    # Echoes are constant at a position and independent between positions.
    pieces: dict[str, Corruption] = {"echoes": gauss_markov(sigma_echo, REPEATS / 10)}
    if detour:
        # Obstructions last as long as a stop, on average.
        pieces["hidden"] = on_anchors(HIDDEN, obstruction(0.5, REPEATS / 10, detour, detour / 2))
    draw = RangeDraw(
        chamber(HALL), lambda keys, times: np.tile(stops, (len(keys), 1, 1)), pieces, n_points=len(stops),
        protocol=PROTOCOL,
    )  # fmt: skip
    return draw.drawn(ids, seed).folder("hall")


def _largest(tracked: mc.TrackedRuns) -> np.ndarray:
    return np.asarray(np.nanmax(np.abs(tracked.error[..., :2]), axis=(1, 2)))


def _span(axis: int) -> Callable[[mc.TrackedRuns], np.ndarray]:
    return lambda tracked: np.nanmax(tracked.error[..., axis], axis=1) - np.nanmin(tracked.error[..., axis], axis=1)


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """Table 1."""
    yield from (figure.beside(results) for figure in PRINTED)
    spans, largest = (
        {w: results.value(measure, w, TRACKER).times(1e3) for w in results.study.worlds}
        for measure in ("span_x_m", "largest_m")
    )
    says = "errors without line of sight are slightly higher than with it"
    how = listed({f"{w}: x over": v for w, v in spans.items()}, "{:.0f} mm")
    yield mc.Conclusion(says, spans["hidden"].low > spans["in sight"].high, how, mc.DERIVED)
    says = "all errors indoors are within ±200 mm (Table 1 itself holds 289, −382 and −237)"
    how = listed({f"{w}: largest": v for w, v in largest.items()}, "{:.0f} mm")
    yield mc.Conclusion(says, max(v.value for v in largest.values()) < 200, how, mc.DERIVED)


NUMBERS = fitted("papers/kwon_2021/line_of_sight")
ECHO = {"sigma_echo": NUMBERS["sigma_echo"]}
STUDY = mc.Study(
    name="line-of-sight",
    about="Table 1 of Kwon et al. 2021: errors of still tags in sight of three anchors, and hidden from them",
    worlds={
        "in sight": mc.World(hall, {"places": 16, **ECHO}),
        "hidden": mc.World(hall, {"places": 4, "detour": NUMBERS["detour"], **ECHO}),
    },
    trackers={TRACKER: mc.TrackerConfig("trilateration"), "with (14)": mc.TrackerConfig("trilateration-compensated")},
    runs=200,
    seed=1,
    measures={"span_x_m": _span(0), "span_y_m": _span(1), "largest_m": _largest},
    metrics=("span_x_m", "span_y_m", "largest_m", "rmse_m"),
    expected=expected,
)

fit = Fit(
    STUDY,
    {"sigma_echo": Fitted(0.07, "m", "in sight, geometric mean of x and y"), "detour": Fitted(0.3, "m", "hidden, x")},
    [PRINTED[:2], PRINTED[2:3]],
    "2 of 4 printed figures",
    runs=60,
)
