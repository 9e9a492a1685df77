"""Surveys: where anchors stand, from ranges of walks without truth, with intervals and verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from trackwright.trackers.core.errors import UnusableInput, listed, one_or_more
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.folder import FOLDERS, RecordingFolder
from trackwright.tuning.calibrating import check_at_rest
from trackwright.tuning.survey.result import COMMON_DELAY, OWN_DELAY, Survey
from trackwright.tuning.survey.solving import FEWEST, Prior, Solution, Walks, covariance_of, design_effect, walks_of
from trackwright.tuning.survey.starts import descended, likelier, multistart, polished, seen_from

HIGHEST, ROUNDS = 1000.0, 3
"""Largest height of tags, m: others are in other units; how often the design effect and the solution are computed."""

EXACT, ASIDE, UNLIKELY = 1e-3, 0.1, 4.0
"""Deviation of exact positions, m; a frame's least height over base; ratio of log-likelihoods that excludes a place."""


def survey(
    recordings: RecordingFolder | Sequence[RecordingFolder], given: Sequence[str] = (), sigma: float = 0.0,
    frame: Sequence[str] = (), height: float | None = None,
) -> Survey:  # fmt: skip
    """The positions and delays of the anchors of recordings with ranges, without their truth.

    `given`: anchors whose positions in the rigs are known with standard deviation `sigma`, m; 0: exactly; or "all".
    Without any given, `frame` names three anchors: the origin, one on the x axis, one to the left of it and, where
    heights are not known, in the plane z = 0; by default the first two and the next aside. `height`: of all tags,
    m, else those that the rigs give; without either, heights are estimated. Raises UnusableInput where that does not
    fix the frame, for fewer than four anchors, and for walks to which no arrangement of them fits.
    """
    folders = one_or_more(recordings, (RecordingFolder,), FOLDERS)
    given, frame = (tuple(x.split(",") if isinstance(x, str) else x) for x in (given, frame))
    names, given, walks = _prepared(folders, given, sigma, frame, height)
    rig, flat = folders[0].rig, np.isfinite(walks.heights).any()
    known = np.array([rig.anchors.get(name, np.full(3, np.nan)) for name in names], float)
    random, prior = np.random.default_rng(0), delays_before(len(names))
    minima = multistart(walks, known, prior, random)
    words = "expected walks with ranges to four anchors within a second; walk where more anchors are heard"
    _require(minima, f"{_where(folders)}: no arrangement of the anchors fits the ranges; {words}")
    minima[0], prior, notes = framed(walks, minima[0], prior, names, known, given, sigma, frame)
    solution, effect = minima[0], 1.0
    for _ in range(ROUNDS):
        tempered = replace(prior, precision=prior.precision * effect)
        solution = polished(walks, solution, tempered, random)
        effect = design_effect(walks, solution, prior.free)
    sides = known if flat or given else np.full_like(known, np.nan)
    solution, mirrored = sided(walks, solution, sides, prior.free.reshape(-1, 4), effect)
    covariance = covariance_of(walks, solution, prior, effect)
    # Given positions are known as well as that, whatever other minima there are.
    searched = prior.free.reshape(-1, 4).copy()
    searched[[names.index(name) for name in given], :3] = False
    covariance += np.diag(searched.ravel() * between(minima, effect, 2 if flat else 3))
    places, at = solution.anchors[:, :3], walks.positions(solution.path)
    squares, readings = (np.bincount(walks.anchor, of) for of in (walks.errors(solution)[0] ** 2, None))
    # Heights of tags that differ from walk to walk are none of the rig.
    heights = {tag: {folder.rig.tags.get(tag, Tag()).height for folder in folders} for tag in rig.tags}
    tags = {k: replace(tag, height=None) if len(heights[k]) > 1 else tag for k, tag in rig.tags.items()}
    estimated = np.isnan(walks.heights)
    words = listed(f"{height:g} m" for height in np.unique(walks.heights[~estimated]))
    words = (
        f"heights of tags known: {words}" if words else "heights of tags estimated; --height states one that is known"
    )
    if 0 < estimated.sum() < len(estimated):
        words += f"; estimated: {listed(dict.fromkeys(np.array(walks.names)[estimated]))}"
    anchors = {**rig.anchors, **dict(zip(names, places.round(4) + 0.0, strict=True))}
    return Survey(
        names=tuple(names), positions=places, delays=solution.anchors[:, 3], covariance=covariance, mirrored=mirrored,
        rms=np.sqrt(squares / readings), readings=readings, effect=effect,
        paths=tuple(at[walks.walk == k] for k in range(len(walks.names))), rig=replace(rig, anchors=anchors, tags=tags),
        notes=(words, *notes),
    )  # fmt: skip


def delays_before(count: int) -> Prior:
    """The density of the delays of so many anchors before any range, and nothing about positions."""
    whole = np.zeros((4 * count, 4 * count))
    whole[3::4, 3::4] = np.linalg.inv(OWN_DELAY**2 * np.eye(count) + COMMON_DELAY**2)
    return Prior(np.zeros(4 * count), whole, np.ones(4 * count, bool))


def _where(folders: Sequence[RecordingFolder]) -> str:
    return listed(str(folder.path or folder.name) for folder in folders)


def _require(fits: object, words: str) -> None:
    if not fits:
        raise UnusableInput(words)


def _prepared(
    folders: Sequence[RecordingFolder], given: tuple[str, ...], sigma: float, frame: Sequence[str], height: float | None
) -> tuple[list[str], tuple[str, ...], Walks]:
    """The anchors, the given ones of them, and the walks; raises UnusableInput for what can't be surveyed."""
    where, rig, of_frame = _where(folders), folders[0].rig, f"frame {','.join(frame)}"
    fits = 0 <= sigma < np.inf and (given or not sigma)
    _require(fits, f"sigma {sigma:g}: is that of given positions; expected metres, 0 if exact, and some named as given")
    _require(abs(height or 0.0) <= HIGHEST, f"height {height}: expected metres, {HIGHEST:g} at most; correct it")
    three = not frame or len({*frame}) == len(frame) == 3
    _require(three, f"{of_frame}: expected three different anchors, as A1,A2,A3")
    _require(not frame or not given, f"{of_frame}: given anchors are a frame; expected one of the two; leave one out")
    ranged = [folder for folder in folders if "ranges" in folder.tables]
    names = sorted({name for folder in ranged for name in folder.tables["ranges"]["anchor"].unique()})
    _require(len(names) >= 4, f"{where}: ranges to {len(names)} anchors; expected 4 at least; record more")
    given = tuple(names) if given == ("all",) else given
    for name in (*given, *frame):
        known = listed(names, 12)
        _require(name in names, f"anchor {name!r} has no readings; expected some of {known}; correct its id")
    for name in given:
        _require(name in rig.anchors, f"{rig.name}: rig.toml has no anchor {name}; add the position of what is given")
    walks = walks_of(ranged, names, height)
    seen = np.bincount(walks.anchor, minlength=len(names))
    words = f"{seen.min()} readings of {names[int(np.argmin(seen))]} without gaps; expected {FEWEST} at least"
    _require(seen.min() >= FEWEST, f"{where}: {words}; record a longer walk")
    # Given anchors stand at one place in all recordings.
    stated = [Rig(x.rig.name, anchors={k: x.rig.anchors[k] for k in given if k in x.rig.anchors}) for x in folders]
    check_at_rest([replace(folder, rig=of) for folder, of in zip(folders, stated, strict=True)])
    return names, given, walks


def aligned(points: np.ndarray, onto: np.ndarray, d: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """The rotation or reflection (3, 3) and shift (3,) of d coordinates of points (k, 3) onto others (Kabsch 1976), two
    of a plane."""
    a, b = points[:, :d], onto[:, :d]
    left, sizes, right = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    moves = []
    for sign in (1.0, -1.0) if sizes[-1] < 1e-2 * sizes[0] else (1.0,):
        turn, shift = np.eye(3), np.zeros(3)
        turn[:d, :d] = (left * np.append(np.ones(d - 1), sign) @ right).T
        shift[:d] = b.mean(axis=0) - turn[:d, :d] @ a.mean(axis=0)
        moves.append((turn, shift))
    return moves


def triangle(names: Sequence[str], frame: Sequence[str], anchors: np.ndarray, d: int) -> tuple[list[int], np.ndarray]:
    """The anchors of the frame, those named, or the first two and the next aside, and their places (3, 3) in it, m."""
    a, b, *others = (names.index(name) for name in frame or names)
    offset = (anchors - anchors[a])[:, :d]
    length = np.linalg.norm(offset[b])
    ahead = offset @ offset[b] / length
    aside = np.sqrt(np.maximum((offset**2).sum(axis=1) - ahead**2, 0.0))
    for c in others:
        if aside[c] > ASIDE * length:
            return [a, b, c], np.array([[0.0, 0.0, 0.0], [length, 0.0, 0.0], [ahead[c], aside[c], 0.0]])
    words = ", ".join(frame or names)
    raise UnusableInput(f"{words}: stand in a line; expected three anchors that do not; give others as --frame")


def framed(
    walks: Walks, solution: Solution, prior: Prior, names: Sequence[str], known: np.ndarray,
    given: Sequence[str], sigma: float, frame: Sequence[str],
) -> tuple[Solution, Prior, list[str]]:  # fmt: skip
    """The solution among the given anchors or in the frame of three, the prior with what that fixes, and assumptions.
    `known` (A, 3): positions, m, of the given ones, of standard deviation `sigma`, m."""
    flat, anchors = bool(np.isfinite(walks.heights).any()), solution.anchors[:, :3]
    d, free, mean, precision = 2 if flat else 3, prior.free.reshape(-1, 4).copy(), prior.mean.copy(), prior.precision
    target, notes = known.copy(), []
    if given:
        chosen = [names.index(name) for name in given]
        places = known[chosen]
        if len(places) < 3 or np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] < 0.1:
            words = "leave a rotation about their line; expected three that are not in one; give more"
            raise UnusableInput(f"given {','.join(given)}: {words}")
        free[chosen, :3] = sigma >= EXACT
        stated = np.isin(np.arange(len(mean)) // 4, chosen) & (np.arange(len(mean)) % 4 < 3)
        mean[stated], precision = places.ravel(), precision + np.diag(stated / max(sigma, EXACT) ** 2)
    else:
        chosen, places = triangle(names, frame, anchors, d)
        target[chosen] = places
        for k, first in zip(chosen, range(3), strict=True):
            free[k, first:d] = False
        if not flat:
            notes.append("the mirror image of all, z as -z, fits as well; tags are assumed below the frame's anchors")
        if not frame:
            words = ", ".join(names[k] for k in chosen)
            notes.append(f"frame: {words}: origin, x axis, and to the left of it; --given or --frame choose another")
    placed = []
    for turn, shift in aligned(anchors[chosen], target[chosen], d):
        moved = solution.anchors.copy()
        moved[:, :3] = np.where(free[:, :3], anchors @ turn.T + shift, target)
        placed.append(replace(solution, anchors=moved, path=solution.path @ turn.T + shift))
    # Of mirror images, that with the tags below the anchors.
    best = min(placed, key=lambda s: walks.positions(s.path)[:, 2].mean())
    return best, Prior(mean, precision, free.ravel()), notes


def sided(
    walks: Walks, solution: Solution, known: np.ndarray, free: Bool[np.ndarray, "A 4"], effect: float
) -> tuple[Solution, Bool[np.ndarray, " A"]]:
    """The solution with anchors on the likely side of the walk's plane, that of `known` (A, 3), else above, and for
    which the other side fits as well. Anchors whose heights are not `free` have no other side."""
    at = walks.positions(solution.path)
    centre = at.mean(axis=0)
    normal = np.linalg.svd(at[:: max(1, len(at) // 2000)] - centre, full_matrices=False)[2][-1]
    anchors, mirrored = solution.anchors.copy(), np.zeros(len(solution.anchors), bool)
    for k in np.flatnonzero(free[:, 2]).tolist():
        anchor = solution.anchors[k, :3]
        offset = (anchor - centre) @ normal
        image = descended(anchor[None] - 2.0 * offset * normal, *seen_from(walks, solution, k))[0]
        if ((image - centre) @ normal) * offset >= 0.0 or likelier(walks, solution, k, image) <= -UNLIKELY * effect:
            continue
        other, mirrored[k] = image[2] > anchor[2], True
        if np.isfinite(known[k, 2]):
            side = np.abs(known[k, 2] - [anchor[2], image[2]])
            other, mirrored[k] = side[1] < side[0], abs(known[k, 2] - centre[2]) < side.min()
        if other:
            anchors[k, :3] = np.where(free[k, :3], image, anchor)
    return replace(solution, anchors=anchors), mirrored


def between(minima: Sequence[Solution], effect: float, d: int) -> Float[np.ndarray, " U"]:
    """The variances, m², of the unknowns by the distances between minima of the cost that are about equally likely.
    `d`: the coordinates of the frame; images above and below a known height of tags `mirrored` states."""
    best, variances = minima[0].anchors, np.zeros_like(minima[0].anchors)
    for other in (x.anchors for x in minima if (x.cost - minima[0].cost) / effect < UNLIKELY):
        moves = aligned(other[:, :3], best[:, :3], d)
        aways = [(other[:, :3] @ turn.T + shift - best[:, :3])[:, :d] for turn, shift in moves]
        squares = min(((away**2).sum(axis=1) for away in aways), key=lambda x: float(x.sum()))
        variances[:, :d] = np.maximum(variances[:, :d], squares[:, None])
        variances[:, 3] = np.maximum(variances[:, 3], (other[:, 3] - best[:, 3]) ** 2)
    return variances.ravel()
