"""`track --fit` on simulated readings with white noise from a third to three times the default one.

Tags of a hall, whose motion is from 0.01 to 2 m/s² per √Hz. The RMSE at default levels, at the fitted ones, and of the
same tracker at the world's own levels; in a last column single epochs by least squares.
"""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import polars as pl
from scipy.optimize import least_squares

import trackwright as tw
from trackwright.experiments.lab.runner import Case, Figures
from trackwright.trackers.core.model.rig import Rig, Station, Tag
from trackwright.trackers.recordings.kinds import KINDS
from trackwright.trackers.recordings.rig_file import mounted
from trackwright.tuning.own_levels import fitted

Predicted = Callable[[np.ndarray], np.ndarray]

NOISE = {"uwb": 0.09, "tdoa": 0.13, "bearings": 0.05, "fix-kf": 0.1}
"""Standard deviations of a reading, m or rad."""

MOTIONS, FACTORS = (0.01, 0.2, 2.0), (1 / 3, 1.0, 3.0)
READING = ("sigma_r", "sigma_d", "sigma_horizontal", "sigma_azimuth", "sigma_elevation")
ROWS, STEP_S, HEIGHT_M = 400, 0.1, 1.2
CORNERS = np.array([[0, 0, 2.5], [10, 0, 2.5], [10, 8, 2.5], [0, 8, 2.5], [5, 0, 0.5], [5, 8, 0.5]], float)
WHITE = {"sigma_bias": 1e-3, "sigma_shared": 1e-3, "dof": 1e3, "positive_skew": 1.0, "latency_std": 1e-3}
"""Numbers of a tracker, by the last part of their names, whose readings have white normal noise."""


def cases() -> Iterator[Case]:
    """`track --fit` on simulated readings: each tracker with each motion and noise."""
    for tracker in NOISE:
        for sigma_a in MOTIONS:
            for factor in FACTORS:
                setting = f"motion {sigma_a:g}, noise {factor:.2g} times the default"
                yield Case("hall", tracker, setting, partial(figures, tracker, sigma_a, factor * NOISE[tracker]))


def figures(tracker: str, sigma_a: float, sigma: float) -> Figures:
    """The errors at the levels of the defaults, of the fit and of the world, and of single epochs."""
    random = np.random.default_rng(1)
    places, times = _walk(sigma_a, random), STEP_S * np.arange(ROWS)
    kind, predicted, rig = _readings(tracker)
    readings = np.stack([predicted(place) for place in places])
    readings += sigma * random.normal(size=readings.shape)
    truth = pl.DataFrame({"t_s": times, "tag": "T", **dict(zip(("x_m", "y_m", "z_m"), places.T, strict=True))})
    tables = {kind: _table(kind, times, readings), "truth": truth}
    folder = tw.RecordingFolder("hall", None, rig, tables)
    named = tw.build(tracker, folder)
    levels = WHITE | {"sigma_a": sigma_a} | dict.fromkeys(READING, sigma)
    of = {name: levels.get(name.rpartition(".")[2]) for name in named.tunables}
    known = {name: np.broadcast_to(x, np.shape(named.tunables[name].value)) for name, x in of.items() if x is not None}
    own = fitted(named, folder)
    sides = {"": named, "_fitted": own.tracker, "_known": named.with_values(known)}
    errors = {f"rmse{k}_m": tw.evaluate(x.run(folder), folder).overall["rmse_m"] for k, x in sides.items()}
    pairs = zip(places[:, :2], readings, strict=True)
    single = [least_squares(lambda xy, z=z: predicted(np.array([*xy, HEIGHT_M])) - z, xy).x for xy, z in pairs]
    return errors | {
        "ratio": errors["rmse_fitted_m"] / errors["rmse_known_m"],
        "rmse_epoch_m": float(np.sqrt(np.mean(np.sum((single - places[:, :2]) ** 2, axis=1)))),
        "stays": int(own.tracker is named),
    }


def _walk(sigma_a: float, random: np.random.Generator) -> np.ndarray:
    """Positions (n, 3), m, of a tag with white acceleration, slowed and pulled back to the middle of the hall."""
    place, speed, walk = np.array([5.0, 4.0]), random.normal(0.0, 0.5, 2), []
    for _ in range(ROWS):
        walk.append([*place, HEIGHT_M])
        pull = speed / 3.0 + (0.002 + 0.3 * sigma_a ** (4 / 3)) * (place - [5.0, 4.0])
        speed = speed + sigma_a * np.sqrt(STEP_S) * random.normal(size=2) - STEP_S * pull
        place = place + speed * STEP_S
    return np.array(walk)


def _table(kind: str, times: np.ndarray, readings: np.ndarray) -> pl.DataFrame:
    """The readings (n, m) as a table of their kind."""
    if kind == "fixes":
        return pl.DataFrame({"t_s": times, "tag": "T", "x_m": readings[:, 0], "y_m": readings[:, 1], "z_m": HEIGHT_M})
    columns = KINDS[kind].least
    values = np.split(readings, len(columns), axis=1)
    names = [f"A{k}" for k in range(values[0].shape[1])]
    *first, last = KINDS[kind].sensors
    ids = {column: [*names[1:], names[0]] * ROWS for column in first} | {last: names * ROWS}
    measured = {column: x.ravel() for column, x in zip(columns, values, strict=True)}
    return pl.DataFrame({"t_s": np.repeat(times, len(names)), "tag": "T", **ids, **measured})


def _readings(tracker: str) -> tuple[str, Predicted, Rig]:
    """The kind of a tracker's readings, their values as a function of the position (3,), and the rig."""
    tags, anchors = {"T": Tag(height=HEIGHT_M)}, {f"A{k}": corner for k, corner in enumerate(CORNERS)}

    def ranges(place: np.ndarray) -> np.ndarray:
        return np.linalg.norm(CORNERS - place, axis=1)

    def bearings(place: np.ndarray) -> np.ndarray:
        away = place - CORNERS[:3]
        return np.concatenate([np.arctan2(away[:, 1], away[:, 0]), np.arctan2(away[:, 2], np.hypot(*away[:, :2].T))])

    if tracker == "uwb":
        return "ranges", ranges, Rig("hall", anchors=anchors, tags=tags)
    if tracker == "tdoa":
        return "tdoa", lambda place: np.roll(ranges(place), -1) - ranges(place), Rig("hall", anchors=anchors, tags=tags)
    if tracker == "bearings":
        stations = {f"A{k}": Station(CORNERS[k], mounted(0.0, 0.0, 0.0)) for k in range(3)}
        return "bearings", bearings, Rig("hall", stations=stations, tags=tags)
    return "fixes", lambda place: place[:2], Rig("hall", tags=tags)
