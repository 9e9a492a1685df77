"""Surveys of anchors with ranges or range differences: their starts, their frames, and what is not unique."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from trackwright.trackers.core.data.consistency import NORMAL
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.tuning.survey.frames import EXACT, aligned, framed, onto, require_frame, tags
from trackwright.tuning.survey.result import COMMON_DELAY, OWN_DELAY, AnchorSurvey
from trackwright.tuning.survey.site import Site, SurveyedTable, residuals_of
from trackwright.tuning.survey.solving import Prior, Solution, information, solved
from trackwright.tuning.survey.starts import (
    FIRST_DENSITY,
    FIRST_SCALE,
    descended,
    misfit,
    multistart,
    polished,
    ranges_to,
)
from trackwright.tuning.survey.walks import LEVEL, RangeWalk, common_height, walks_of

CLOCK = 0.2
"""Standard deviation, m, of the offset of an anchor's clock before any range difference."""

UNLIKELY = 4.0
"""Log-likelihood ratio from which a mirror image is excluded."""

LIFT = 1.0
"""Height over a walk, m, from which an anchor at its height is tried again."""


class AnchorTable(SurveyedTable[RangeWalk]):
    """Ranges or range differences, of which the unknowns are positions and delays of anchors."""

    least = 4

    def walks(self, folders: Sequence[RecordingFolder], names: Sequence[str], height: float | None) -> list[RangeWalk]:
        return walks_of(folders, names, height, self.name)

    def stated(self, site: Site[RangeWalk], rig: Rig) -> Rig:
        return Rig(rig.name, anchors={name: rig.anchors[name] for name in site.given if name in rig.anchors})

    def begun(self, site: Site[RangeWalk], random: np.random.Generator) -> tuple[list[Solution], Prior]:
        prior = self.prior(len(site.names))
        minima = self.starts(site, prior, random)
        if not site.given:
            return minima, prior
        require_frame(site.known[site.fixed], site.given)
        start, prior = onto(site.walks, minima[0], site.known, site.fixed, site.sigma, site.flat, prior)
        return [start, *minima[1:]], prior

    def finished(
        self, site: Site[RangeWalk], solution: Solution, prior: Prior, effect: float, notes: Sequence[str],
        minima: Sequence[Solution],
    ) -> AnchorSurvey:  # fmt: skip
        walks, notes = site.walks, list(notes)
        if not site.given:
            solution, prior, words = framed(walks, solution, site.names, site.frame, site.flat, prior)
            notes += words
        solution, mirrored = self.sides(site, solution, prior, effect)
        covariance = _covariance(walks, solution, prior, effect)
        # Given positions are known as well as that, whatever other minima there are.
        searched = np.diag(covariance) > 0.0
        searched[[4 * k + axis for k in site.fixed for axis in range(3)]] = False
        covariance += np.diag(np.where(searched, _between(minima, effect, site.flat), 0.0))
        readings, rms = residuals_of(walks, solution)
        before, positions = site.folders[0].rig, solution.sensors[:, :3]
        anchors = {**before.anchors, **dict(zip(site.names, positions.round(4) + 0.0, strict=True))}
        return AnchorSurvey(
            names=tuple(site.names), positions=positions, delays=solution.sensors[:, 3], covariance=covariance,
            mirrored=mirrored, scales=solution.scales, densities=solution.densities, rms=rms, readings=readings,
            effect=effect, paths=site.paths(solution), rig=replace(before, anchors=anchors), before=before,
            notes=tuple(notes),
        )  # fmt: skip

    @abstractmethod
    def prior(self, count: int) -> Prior:
        """The density of the delays of so many anchors before any reading; nothing about positions."""

    @abstractmethod
    def starts(self, site: Site[RangeWalk], prior: Prior, random: np.random.Generator) -> list[Solution]:
        """Solutions to start from, the best first; raises UnusableInput where there is none."""

    @abstractmethod
    def sides(
        self, site: Site[RangeWalk], solution: Solution, prior: Prior, effect: float
    ) -> tuple[Solution, Bool[np.ndarray, " A"]]:
        """The solution with anchors on the likely side of the walk, and of which the other side fits as well."""


class Ranges(AnchorTable):
    """Ranges, which find anchors from nothing, in a frame that three of them define."""

    name = "ranges"

    def prior(self, count: int) -> Prior:
        return _of_delays(np.linalg.inv(OWN_DELAY**2 * np.eye(count) + COMMON_DELAY**2))

    def starts(self, site: Site[RangeWalk], prior: Prior, random: np.random.Generator) -> list[Solution]:
        minima = multistart(site.walks, site.known, prior, random)
        if not minima:
            raise UnusableInput(
                f"{site.where}: no arrangement of the anchors fits the ranges; expected walks with ranges to four "
                "anchors within a second; walk where more anchors are heard"
            )
        return minima

    def solved(
        self, walks: Sequence[RangeWalk], start: Solution, prior: Prior, random: np.random.Generator
    ) -> Solution:
        return polished(walks, solved(walks, start, prior), prior, random)

    def settled(self, walks: Sequence[RangeWalk], solution: Solution, prior: Prior) -> Solution:
        return min(_off_level(walks, solution, prior), key=lambda s: s.cost)

    def sides(
        self, site: Site[RangeWalk], solution: Solution, prior: Prior, effect: float
    ) -> tuple[Solution, Bool[np.ndarray, " A"]]:
        known = site.known if site.flat or site.given else None
        return _sided(site.walks, solution, known, prior.free.reshape(-1, 4), effect)


class Differences(AnchorTable):
    """Range differences, which refine given positions of all anchors; their delays are relative to the mean."""

    name = "tdoa"

    def prior(self, count: int) -> Prior:
        # Clocks: their offsets are larger than delays of antennas. Their mean is in no difference.
        return _of_delays(np.eye(count) / CLOCK**2 + 1.0 / (count * EXACT) ** 2)

    def starts(self, site: Site[RangeWalk], prior: Prior, random: np.random.Generator) -> list[Solution]:
        """As the tracker of range differences has the paths at the given anchors."""
        if len(site.given) < len(site.names) or not np.isfinite(site.known).all():
            raise UnusableInput(
                f"{site.where}: range differences refine positions of anchors that are roughly known; expected all of "
                "them in rig.toml; add them, and give all with their standard deviation"
            )
        # jax takes a second to import, which a survey with ranges need not wait for.
        from trackwright.trackers.catalogue import build

        table = build("tdoa", site.folders).smoothing().run(site.folders).table
        paths = []
        for walk in site.walks:
            mine = (table["recording"] == walk.recording) & (table["tag"] == walk.tag)
            places = table.filter(mine).select("t_s", "x_m", "y_m", "z_m").drop_nulls(["x_m", "y_m"]).to_numpy()
            if not len(places):
                raise UnusableInput(
                    f"{walk.recording}: tag {walk.tag} cannot be tracked; expected range differences of it"
                )
            at = [np.interp(walk.times, places[:, 0], np.nan_to_num(column)) for column in places[:, 1:].T]
            paths.append(walk.fitted(np.stack(at, axis=1)))
        count = len(site.names)
        anchors = np.column_stack([site.known, np.zeros(count)])
        levels = np.full(count, FIRST_SCALE), np.full(len(site.walks), FIRST_DENSITY)
        return [Solution(anchors, paths, *levels)]

    def sides(
        self, site: Site[RangeWalk], solution: Solution, prior: Prior, effect: float
    ) -> tuple[Solution, Bool[np.ndarray, " A"]]:
        return solution, np.zeros(len(site.names), bool)


def _of_delays(precision: Float[np.ndarray, "A A"]) -> Prior:
    """The density with this precision of delays, and nothing about positions."""
    count = len(precision)
    whole = np.zeros((4 * count, 4 * count))
    whole[3::4, 3::4] = precision
    return Prior(np.zeros(4 * count), whole, np.ones(4 * count, bool))


def _off_level(walks: Sequence[RangeWalk], solution: Solution, prior: Prior) -> list[Solution]:
    """The solution, and that from a start with the anchors at the walk's height above it, where it has one.

    At that height the derivative by the height is zero: a fit stays there, whether or not it is best.
    """
    height, anchors = common_height(walks), solution.sensors.copy()
    level = prior.free[2::4] & (np.abs(anchors[:, 2] - (np.inf if height is None else height)) < LEVEL)
    anchors[level, 2] += LIFT
    starts = [solution, replace(solution, sensors=anchors)][: 1 + level.any()]
    return [solved(walks, start, prior) for start in starts]


def _sided(
    walks: Sequence[RangeWalk],
    solution: Solution,
    known: np.ndarray | None,
    free: Bool[np.ndarray, "A 4"],
    effect: float,
) -> tuple[Solution, Bool[np.ndarray, " A"]]:
    """The solution with anchors on the likely side of the walk's plane, and of which the other side fits as well.

    That side is where the rig has an anchor, `known` (A, 3), NaN where it does not, and otherwise above. Anchors whose
    heights are not `free` have no other side.
    """
    at = tags(walks, solution)
    centre = at.mean(axis=0)
    normal = np.linalg.svd(at[:: max(1, len(at) // 2000)] - centre, full_matrices=False)[2][-1]
    anchors, mirrored = solution.sensors.copy(), np.zeros(len(solution.sensors), bool)
    for k in np.flatnonzero(free[:, 2]).tolist():
        anchor = solution.sensors[k]
        positions, ranges = ranges_to(walks, solution, k)
        offset = (anchor[:3] - centre) @ normal
        image = descended(anchor[None, :3] - 2.0 * offset * normal, positions, ranges, anchor[3])[0]
        if ((image - centre) @ normal) * offset >= 0.0:
            continue
        worse = misfit(image, positions, ranges - anchor[3], solution.scales[k])
        worse -= misfit(anchor[:3], positions, ranges - anchor[3], solution.scales[k])
        if worse / effect >= UNLIKELY:
            continue
        other, mirrored[k] = image[2] > anchor[2], True
        if known is not None and np.isfinite(known[k, 2]):
            side = np.abs(known[k, 2] - [anchor[2], image[2]])
            other, mirrored[k] = side[1] < side[0], abs(known[k, 2] - centre[2]) < side.min()
        if other:
            anchors[k, :3] = np.where(free[k, :3], image, anchor[:3])
    return replace(solution, sensors=anchors), mirrored


def _covariance(
    walks: Sequence[RangeWalk], solution: Solution, prior: Prior, effect: float
) -> Float[np.ndarray, "U U"]:
    """The covariance of what is free."""
    free = np.flatnonzero(prior.free)
    height, lifted = common_height(walks), solution.sensors.copy()
    if height is not None:
        # Ranges see the square of a height over the walk, whose derivative by that height vanishes at zero.
        over = lifted[:, 2] - height
        sizes = np.maximum(np.abs(over), LEVEL)
        lifted[:, 2] = height + np.copysign(sizes, over)
    precision = information(walks, replace(solution, sensors=lifted)) / effect + prior.precision
    covariance = np.zeros_like(precision)
    # A standard deviation of a kilometre for what nothing determines.
    covariance[np.ix_(free, free)] = np.linalg.inv(precision[np.ix_(free, free)] + 1e-6 * np.eye(len(free)))
    if height is not None:
        for k in np.flatnonzero((prior.free & (np.diag(prior.precision) == 0.0)).reshape(-1, 4)[:, 2]):
            # The interval is the root of that of the square.
            row, deviation = 4 * k + 2, np.sqrt(covariance[4 * k + 2, 4 * k + 2])
            square = over[k] ** 2 + 2.0 * sizes[k] * NORMAL * deviation * np.array([-1.0, 1.0])
            wider = np.abs(np.sqrt(np.maximum(square, 0.0)) - abs(over[k])).max() / (NORMAL * deviation)
            covariance[row, :] *= wider
            covariance[:, row] *= wider
    return covariance


def _between(minima: Sequence[Solution], effect: float, flat: bool) -> Float[np.ndarray, " U"]:
    """The variances, m², of the unknowns by the distances between minima of the cost that are about equally likely."""
    best, d = minima[0].sensors, 2 if flat else 3
    variances = np.zeros_like(best)
    for other in minima[1:]:
        if (other.cost - minima[0].cost) / effect < UNLIKELY:
            moves = aligned(other.sensors[:, :3], best[:, :3], d)
            places = [other.sensors[:, :3] @ turn.T + shift for turn, shift in moves]
            away = min((place - best[:, :3] for place in places), key=lambda x: float((x[:, :d] ** 2).sum()))
            # A known height of tags leaves images above and below, which `mirrored` states.
            away[:, d:] = 0.0
            variances[:, :d] = np.maximum(variances[:, :d], (away**2).sum(axis=1)[:, None])
            variances[:, 3] = np.maximum(variances[:, 3], (other.sensors[:, 3] - best[:, 3]) ** 2)
    return variances.ravel()
