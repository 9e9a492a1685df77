"""Surveys of stations with bearings: positions and rotations among given ones, with the gains of their angles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.calibration import ANGLE_PRIOR
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.tuning.survey.anchors import UNLIKELY
from trackwright.tuning.survey.bearings import (
    GAINS,
    POSITION,
    TURN,
    UNKNOWNS,
    BearingWalk,
    bearing_walks,
    right_jacobians,
    rotations,
)
from trackwright.tuning.survey.frames import EXACT
from trackwright.tuning.survey.site import Site, SurveyedTable, residuals_of
from trackwright.tuning.survey.solving import Prior, Solution, information, solved
from trackwright.tuning.survey.starts import FIRST_DENSITY
from trackwright.tuning.survey.station_result import StationSurvey
from trackwright.tuning.survey.station_starts import (
    any_rotations,
    directions,
    intersected,
    level_rotations,
    path_between,
    placed,
    rotations_found,
)
from trackwright.tuning.survey.volume import volume_slope

FIRST_SCALE = 0.1
"""Scale of errors, rad, with which the search begins."""

TILTS, STEPS, SETTLED = 8, 6, 1e-3
"""How often the slope of the paths' volume, and so many steps with it, are taken in turn; the last move, m or rad."""

KEPT, APART, FEW, REFINED = 3, 0.3, 8, 3
"""Starts: how many, how far apart, rad, solved in how few steps, and how many of them to the end."""


class Bearings(SurveyedTable[BearingWalk]):
    """Bearings, which see neither the origin nor the scale: positions of stations are given, two at least.

    One will do where its rotation and the height of the tag are known, too.
    """

    name = "bearings"
    least = 2
    levels = 2

    def walks(
        self, folders: Sequence[RecordingFolder], names: Sequence[str], height: float | None
    ) -> list[BearingWalk]:
        return bearing_walks(folders, names, height)

    def stated(self, site: Site[BearingWalk], rig: Rig) -> Rig:
        stations = {name: rig.stations[name] for name in site.given if name in rig.stations}
        if site.sigma_turn is None:
            stations = {name: replace(station, rotation=np.eye(4)[0]) for name, station in stations.items()}
        return Rig(rig.name, stations=stations)

    def begun(self, site: Site[BearingWalk], random: np.random.Generator) -> tuple[list[Solution], Prior]:
        _require_frame(site)
        prior = prior_of(site)
        tried = sorted((solved(site.walks, start, prior, FEW) for start in starts(site, random)), key=lambda s: s.cost)
        refined = [solved(site.walks, start, prior) for start in tried[:REFINED]]
        return sorted([*refined, *tried[REFINED:]], key=lambda s: s.cost), prior

    def solved(
        self, walks: Sequence[BearingWalk], start: Solution, prior: Prior, random: np.random.Generator
    ) -> Solution:
        """The solution of greatest likelihood with the paths integrated out."""
        solution = start
        for _ in range(TILTS):
            before = solution
            solution = solved(walks, before, replace(prior, tilt=volume_slope(walks, before)), STEPS)
            if np.abs(solution.sensors - before.sensors).max() < SETTLED:
                break
        return solution

    def finished(
        self, site: Site[BearingWalk], solution: Solution, prior: Prior, effect: float, notes: Sequence[str],
        minima: Sequence[Solution],
    ) -> StationSurvey:  # fmt: skip
        references = site.walks[0].references
        before, positions = site.folders[0].rig, solution.sensors[:, POSITION]
        quaternions = Rotation.from_matrix(rotations(solution.sensors, references)).as_quat(scalar_first=True)
        stations = {
            name: replace(before.stations[name], position=position.round(4) + 0.0, rotation=rotation.round(6) + 0.0)
            for name, position, rotation in zip(site.names, positions, quaternions, strict=True)
        }
        readings, rms = residuals_of(site.walks, solution)
        return StationSurvey(
            names=tuple(site.names), positions=positions, rotations=quaternions, gains=solution.sensors[:, GAINS],
            covariance=_covariance(site, solution, prior, effect, minima), scales=solution.scales,
            densities=solution.densities, rms=rms, readings=readings, rms_before=_rms_before(site, solution, prior),
            effect=effect, paths=site.paths(solution),
            rig=replace(before, stations={**before.stations, **stations}), before=before,
            fixed_height=site.flat, notes=tuple(notes),
        )  # fmt: skip


def _require_frame(site: Site[BearingWalk]) -> None:
    """Raises UnusableInput where given positions fix neither the origin nor the scale."""
    places = site.known[site.fixed]
    apart = np.linalg.norm(places - places[:1], axis=1).max(initial=0.0) > 0.1
    if not apart and not (len(places) and site.flat and site.sigma_turn is not None):
        raise UnusableInput(
            f"{site.where}: bearings see neither the origin nor the scale; expected two given stations apart, or one "
            "of known rotation and the tag's height; name them as given"
        )


def prior_of(site: Site[BearingWalk]) -> Prior:
    """The density of the unknowns of stations before any bearing: given positions, stated rotations, and gains."""
    count = len(site.names)
    mean, precision = np.zeros((count, UNKNOWNS)), np.zeros((count, UNKNOWNS))
    free = np.ones((count, UNKNOWNS), bool)
    mean[:, GAINS], precision[:, GAINS] = ANGLE_PRIOR[0][1], ANGLE_PRIOR[1][1] ** -2
    mean[site.fixed, POSITION] = site.known[site.fixed]
    if site.sigma < EXACT:
        free[site.fixed, POSITION] = False
    else:
        precision[site.fixed, POSITION] = site.sigma**-2
    if site.sigma_turn is not None and site.sigma_turn < EXACT:
        free[:, TURN] = False
    elif site.sigma_turn is not None:
        precision[:, TURN] = site.sigma_turn**-2
    return Prior(mean.ravel(), np.diag(precision.ravel()), free.ravel())


def starts(site: Site[BearingWalk], random: np.random.Generator) -> list[Solution]:
    """Solutions to start from, with stations whose rotations are not stated turned onto the paths of their rays."""
    walks, fixed, count = site.walks, site.fixed, len(site.names)
    references = walks[0].references
    epochs = [directions(walk, count) for walk in walks]
    local = np.concatenate([found for _, found in epochs])
    heights = np.concatenate(
        [np.full(len(times), walk.height, float) for walk, (times, _) in zip(walks, epochs, strict=True)]
    )
    if site.sigma_turn is None:
        # Stations that hang upside down fit some walks as well: both are tried.
        pools = []
        for drawn in (level_rotations(random), any_rotations(random)):
            turns, points = rotations_found(site.known[fixed], local[:, fixed], heights, drawn, random)
            chosen = _different(turns)
            pools.append((turns[chosen], points[chosen]))
        turns, points = (np.concatenate(of) for of in zip(*pools, strict=True))
    else:
        turns = references[fixed][None]
        points = intersected(site.known[fixed], np.einsum("csij,ksj->cksi", turns, local[:, fixed]), heights)
    ends = np.cumsum([len(times) for times, _ in epochs])[:-1]
    found = []
    for turn, way in zip(turns, points, strict=True):
        sensors = np.zeros((count, UNKNOWNS))
        sensors[:, GAINS], sensors[fixed, POSITION] = 1.0, site.known[fixed]
        sensors[fixed, TURN] = Rotation.from_matrix(np.swapaxes(references[fixed], 1, 2) @ turn).as_rotvec()
        for k in np.setdiff1d(np.arange(count), fixed):
            sensors[k, POSITION], rotation = placed(way, local[:, k], random)
            sensors[k, TURN] = Rotation.from_matrix(references[k].T @ rotation).as_rotvec()
        if site.sigma_turn is not None and site.sigma_turn < EXACT:
            sensors[:, TURN] = 0.0
        paths = [path_between(walk, times, part)
                 for walk, (times, _), part in zip(walks, epochs, np.split(way, ends), strict=True)]  # fmt: skip
        levels = np.full(2 * count, FIRST_SCALE), np.full((len(walks), 3), FIRST_DENSITY)
        found.append(Solution(sensors, paths, *levels))
    return found


def _different(turns: Float[np.ndarray, "c S 3 3"]) -> list[int]:
    """The numbers of the first rotations of stations that differ from each other."""
    chosen: list[int] = []
    for k, turn in enumerate(turns):
        # The squared distance of two matrices is 4 (1 − cos) of the angle between them.
        apart = [((turn - turns[other]) ** 2).sum(axis=(1, 2)).max() > 2.0 * APART**2 for other in chosen]
        if all(apart):
            chosen.append(k)
        if len(chosen) == KEPT:
            break
    return chosen


def _covariance(
    site: Site[BearingWalk], solution: Solution, prior: Prior, effect: float, minima: Sequence[Solution]
) -> Float[np.ndarray, "U U"]:
    """The covariance of positions, m, turns about the axes of the array, rad, and gains of each station."""
    free, references = np.flatnonzero(prior.free), site.walks[0].references
    precision = information(site.walks, solution) / effect + prior.precision
    covariance = np.zeros_like(precision)
    # A standard deviation of a kilometre for what nothing determines.
    covariance[np.ix_(free, free)] = np.linalg.inv(precision[np.ix_(free, free)] + 1e-6 * np.eye(len(free)))
    jacobians = right_jacobians(solution.sensors[:, TURN])
    whole = block_diag(*(block_diag(np.eye(3), jacobian, np.eye(2)) for jacobian in jacobians))
    covariance = whole @ covariance @ whole.T
    # Other minima that are about equally likely, less what is given.
    away = np.zeros_like(solution.sensors)
    turns = rotations(minima[0].sensors, references)
    for other in minima[1:]:
        if (other.cost - minima[0].cost) / effect < UNLIKELY:
            apart = other.sensors - minima[0].sensors
            between = np.swapaxes(turns, 1, 2) @ rotations(other.sensors, references)
            apart[:, TURN] = Rotation.from_matrix(between).as_rotvec()
            away = np.maximum(away, apart**2)
    away[site.fixed, POSITION] = 0.0
    return covariance + np.diag(np.where(prior.free, away.ravel(), 0.0))


def _rms_before(site: Site[BearingWalk], solution: Solution, prior: Prior) -> Float[np.ndarray, " levels"] | None:
    """The root mean squares of errors, rad, with the stations as the rig has them; None where it is not stated."""
    if site.sigma_turn is None or len(site.given) < len(site.names):
        return None
    as_given = replace(solution, sensors=prior.mean.reshape(-1, UNKNOWNS))
    held = replace(prior, free=np.zeros_like(prior.free))
    return residuals_of(site.walks, solved(site.walks, as_given, held, levels=False))[1]
