"""Calibrations: the systematic errors of stations and anchors, with their covariances, and their file calibration.toml.

A station measures each angle a as offset + gain·a + cubic·a³ + cross·a·b, where b is the other angle, both in its array
frame. An anchor measures the distance d of a tag as d + bias + slope·d + the tag's bias. The fit is in
`tuning/calibrating.py`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import tomli_w
from jaxtyping import Float
from pydantic import BeforeValidator, Field

from trackwright.trackers.core.model.rig import Point, Rig, Station
from trackwright.trackers.recordings.files import (
    AS_FILE,
    NUMBERS,
    Count,
    Number,
    Positive,
    atomic_write,
    json_text,
    read_model,
)

ANGLES = ("azimuth", "elevation")

ANGLE_PRIOR = np.array([0.0, 1.0, 0.0, 0.0]), np.array([0.2, 0.3, 0.2, 0.2])  # mean, sd; rad to the power of each term
RANGE_PRIOR = np.zeros(2), np.array([0.3, 0.02])  # mean and standard deviation of bias, m, and slope
TAG_SIGMA = 0.05  # standard deviation of the bias of a tag, m, relative to other tags, before any recording
OFFSET_SIGMA = 0.02  # of where the ranges of a tag end, m, before any recording
MOVED_M, MOVED_RAD = 0.1, 0.05  # what a station or anchor may have moved since its calibration
DETERMINED = 0.7  # largest standard deviation of a determined term, as a share of the prior's
LARGEST_ANGLES = np.array([np.pi, np.pi / 2])  # the largest azimuth and elevation, rad

_NEWTON_STEPS, _CONVERGED = 20, 1e-10

FORMAT = 1
COMMENT = "# Written by `trackwright calibrate`; read by `--calibration` of `track` and `tune`.\n"


def angle_terms(true: np.ndarray, spans: np.ndarray) -> np.ndarray:
    """Factors (..., 2, 4) of the terms at true angles (..., 2), rad; linear beyond the `spans` (..., 2, 2)."""
    inside = np.clip(true, spans[..., 0], spans[..., 1])
    cubic = inside**2 * (3.0 * true - 2.0 * inside)
    return np.stack([np.ones_like(true), true, cubic, true * inside[..., ::-1]], axis=-1)


def range_terms(distances: np.ndarray) -> np.ndarray:
    """The factors (..., 2) of bias and slope, at distances (...), m."""
    return np.stack([np.ones_like(distances), distances], axis=-1)


def _station(given: Any) -> Any:
    """A station from a table of a file."""
    return Station(np.array(given["position"]), np.array(given["rotation"])) if isinstance(given, dict) else given


@dataclass(frozen=True)
class StationCalibration:
    """The terms of a station's azimuth and elevation.

    `coefficients` (2, 4): offset, rad, gain, cubic, rad⁻², and cross, rad⁻¹, of each angle; `covariances` (2, 4, 4).
    `spans` (2, 2): the lowest and the highest true angle in the recordings of the fit, rad. `rows`: their number.
    `mounted`: where the station stood; None for anywhere.
    """

    __pydantic_config__: ClassVar = AS_FILE

    coefficients: Annotated[Float[np.ndarray, "2 4"], NUMBERS]
    covariances: Annotated[Float[np.ndarray, "2 4 4"], NUMBERS]
    spans: Annotated[Float[np.ndarray, "2 2"], NUMBERS]
    rows: Count = 0
    mounted: Annotated[Station | None, BeforeValidator(_station)] = None

    def measured(self, true: np.ndarray) -> np.ndarray:
        """The angles (..., 2), rad, that the station measures at true angles (..., 2), without noise."""
        return (angle_terms(true, self.spans) * self.coefficients).sum(axis=-1)

    def true(self, measured: np.ndarray) -> np.ndarray:
        """The true angles (..., 2), rad, at which the station measures these angles (..., 2)."""
        return _true(measured, self.coefficients, self.spans)


UNCALIBRATED = StationCalibration(
    np.tile(ANGLE_PRIOR[0], (2, 1)), np.zeros((2, 4, 4)), np.stack([-LARGEST_ANGLES, LARGEST_ANGLES], axis=1)
)
"""A station without systematic errors."""


@dataclass(frozen=True)
class AnchorCalibration:
    """Bias, m, and slope of an anchor's ranges, and their covariance.

    `span`: smallest and largest distance of the fit, m. `rows`: their number. `position`: where it stood, or None.
    """

    __pydantic_config__: ClassVar = AS_FILE

    coefficients: Annotated[Float[np.ndarray, " 2"], NUMBERS]
    covariance: Annotated[Float[np.ndarray, "2 2"], NUMBERS]
    span: Annotated[Float[np.ndarray, " 2"], NUMBERS]
    rows: Count = 0
    position: Annotated[Point | None, NUMBERS] = None


@dataclass(frozen=True)
class TagCalibration:
    """Bias of a tag's ranges relative to the mean of all tags of the fit, and its standard deviation, m.

    `offset`: from its place on the body to where its ranges end, ahead and to the left, m; zero without a heading.
    """

    __pydantic_config__: ClassVar = AS_FILE

    bias: Number
    sigma: Annotated[Number, Field(ge=0.0)]
    rows: Count = 0
    offset: tuple[float, float] = (0.0, 0.0)
    offset_sigmas: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Calibration:
    """Systematic errors of stations, anchors and tags by their ids; `recordings`: their names in the fit.

    `range_spread`: scale of Student's t of the ranges about the fit, m, root mean square over the anchors.
    `bearing_map`: visits (V, 4) of a station: x and y, m, and mean errors that its terms leave of both angles, rad.
    """

    __pydantic_config__: ClassVar = AS_FILE

    stations: Mapping[str, StationCalibration] = field(default_factory=dict)
    anchors: Mapping[str, AnchorCalibration] = field(default_factory=dict)
    tags: Mapping[str, TagCalibration] = field(default_factory=dict)
    recordings: tuple[str, ...] = ()
    range_spread: Positive | None = None
    bearing_map: Mapping[str, Annotated[Float[np.ndarray, "V 4"], NUMBERS]] = field(default_factory=dict)

    def at_rest(self, rig: Rig) -> Calibration:
        """The calibration of those stations and anchors of a rig that stand where they stood."""
        places, there = rig.anchors, rig.stations
        anchors = {k: x for k, x in self.anchors.items() if k in places and not has_moved(x.position, places[k])}
        stations = {k: x for k, x in self.stations.items() if k in there and not has_turned(x.mounted, there[k])}
        by_place = {name: visits for name, visits in self.bearing_map.items() if name in stations}
        return replace(self, stations=stations, anchors=anchors, bearing_map=by_place)

    def of_bearings(
        self, stations: Sequence[str], number: np.ndarray, measured: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of bearings (N, 2), rad: terms and spans (N, 12), true angles (N, 2), variances that the terms add (N, 2)."""
        of = [self.stations.get(name, UNCALIBRATED) for name in stations]
        coefficients, spans = np.stack([x.coefficients for x in of])[number], np.stack([x.spans for x in of])[number]
        true = _true(measured, coefficients, spans)
        variances = _variances(angle_terms(true, spans), [x.covariances for x in of], number)
        return np.concatenate([coefficients.reshape(-1, 8), spans.reshape(-1, 4)], axis=1), true, variances

    def of_ranges(
        self, anchors: Sequence[str], number: np.ndarray, tags: Sequence[str], tag: np.ndarray, measured: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Distances (N,), m, of ranges, and the variances that the terms add, m²; a tag not known has the mean bias."""
        none = AnchorCalibration(np.zeros(2), np.zeros((2, 2)), np.zeros(2))
        of = [self.anchors.get(name, none) for name in anchors]
        other = TagCalibration(0.0, TAG_SIGMA if self.tags else 0.0)
        biases = np.array([(x.bias, x.sigma**2) for x in (self.tags.get(name, other) for name in tags)])[tag]
        known = np.array([name in self.anchors for name in anchors])[number]
        tag_bias, tag_variance = np.where(known[:, None], biases, 0.0).T
        bias, slope = np.stack([x.coefficients for x in of])[number].T
        distances = (measured - bias - tag_bias) / (1.0 + slope)
        variances = tag_variance + _variances(range_terms(distances), [x.covariance for x in of], number)
        return distances, variances / (1.0 + slope) ** 2


def _variances(factors: np.ndarray, covariances: Sequence[np.ndarray], number: np.ndarray) -> np.ndarray:
    """The variances φᵀ·covariance·φ (N, …) of factors φ (N, …, k) with `covariances[number]` (…, k, k)."""
    result = np.zeros(factors.shape[:-1])
    for k, covariance in enumerate(covariances):
        part = number == k
        result[part] = np.einsum("n...i,...ij,n...j->n...", factors[part], covariance, factors[part])
    return result


def has_moved(before: Point | None, now: Point) -> bool:
    """Whether two positions (3,), m, are different places; not of one that is not known."""
    return before is not None and float(np.linalg.norm(np.asarray(now) - before)) > MOVED_M


def has_turned(before: Station | None, now: Station) -> bool:
    """Whether a station stands at another place, or otherwise turned; not of one that is not known."""
    if before is None:
        return False
    # The trace of a rotation is 1 + 2 cos of its angle.
    cosine = 0.5 * (np.trace(before.world_from_array().T @ now.world_from_array()) - 1.0)
    return has_moved(before.position, now.position) or float(np.arccos(np.clip(cosine, -1.0, 1.0))) > MOVED_RAD


def _true(measured: np.ndarray, coefficients: np.ndarray, spans: np.ndarray) -> np.ndarray:
    """The true angles, by Newton's method within the largest angles."""
    _, gain, cubic, cross = np.moveaxis(coefficients, -1, 0)
    angles = np.asarray(measured, float)
    for _ in range(_NEWTON_STEPS):
        inside = np.clip(angles, spans[..., 0], spans[..., 1])
        diagonal = gain + 3.0 * cubic * inside**2 + cross * inside[..., ::-1]
        other = np.where((inside == angles)[..., ::-1], cross * angles, 0.0)
        miss = measured - (angle_terms(angles, spans) * coefficients).sum(axis=-1)
        determinant = diagonal[..., :1] * diagonal[..., 1:] - other[..., :1] * other[..., 1:]
        step = (diagonal[..., ::-1] * miss - other * miss[..., ::-1]) / determinant
        before, angles = angles, np.clip(angles + step, -LARGEST_ANGLES, LARGEST_ANGLES)
        if np.abs(angles - before).max(initial=0.0) < _CONVERGED:
            break
    return angles


def write_calibration(calibration: Calibration, path: str | Path) -> Path:
    """Writes the calibration to the file `path`, completely or not at all; raises UnusableInput where it cannot be."""
    content = asdict(calibration, dict_factory=lambda pairs: {key: x for key, x in pairs if x is not None})
    text = COMMENT + tomli_w.dumps({"format": FORMAT, **json.loads(json_text(content))})
    return atomic_write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def read_calibration(path: str | Path) -> Calibration:
    """The calibration in a `calibration.toml`; raises UnusableInput for content that `calibrate` does not write."""
    expected = f"the calibration.toml of `trackwright calibrate`, format = {FORMAT}"
    return read_model(Path(path), Calibration, expected, "write it with `trackwright calibrate`", FORMAT)


PLACE_SIGMA, VISIT_SIGMA = np.array([0.1, 0.2]), np.array([0.06, 0.15])  # rad, of the map's angles, of a visit about it
LENGTH_M = 0.6  # of the kernel exp(−distance/length)
STEP_M, MARGIN_M, MOST_NODES = 0.1, 2.0, 200  # of a grid: step, margin, nodes along a side before the step is larger
UNKNOWN = np.concatenate([np.zeros(2), np.hypot(PLACE_SIGMA, VISIT_SIGMA)])  # the values off a grid


def predicted(visits: Float[np.ndarray, "V 4"], places: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 4"]:
    """Means of the errors of both angles of a visit to `places`, m, given earlier `visits`, and their sds, rad."""
    among, across = (
        np.exp(-np.linalg.norm(visits[:, None, :2] - other, axis=-1) / LENGTH_M) for other in (visits[:, :2], places)
    )
    # Both angles share the kernel, and thus its eigenvectors.
    eigenvalues, axes = np.linalg.eigh(among)
    across = axes.T @ across
    gains = PLACE_SIGMA**2 / (np.multiply.outer(eigenvalues, PLACE_SIGMA**2) + VISIT_SIGMA**2)
    means = across.T @ (gains * (axes.T @ visits[:, 2:]))
    variances = PLACE_SIGMA**2 * np.maximum(1.0 - (across**2).T @ gains, 0.0) + VISIT_SIGMA**2
    return np.concatenate([means, np.sqrt(variances)], axis=1)


def floor_grid(
    visits: Mapping[str, Float[np.ndarray, "V 4"]], stations: Sequence[str], origin: Sequence[float] = (0.0, 0.0)
) -> tuple[Float[np.ndarray, "S X Y 4"], Float[np.ndarray, " 2"], float]:
    """The map of stations at the nodes of a grid around all visits: as `predicted`; first node about `origin`; step."""
    places = np.concatenate([of_station[:, :2] for of_station in visits.values()]) - origin
    low, high = places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M
    step = max(STEP_M, float((high - low).max()) / MOST_NODES)
    counts = np.ceil((high - low) / step).astype(int) + 1
    nodes = low + step * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 2)
    values = [predicted(visits.get(name, np.zeros((0, 4))) - [*origin, 0.0, 0.0], nodes) for name in stations]
    return np.stack(values).reshape(len(stations), *counts, 4), low, step
