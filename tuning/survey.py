"""Where anchors stand, and their delays, from ranges of walks without truth, with intervals and verdicts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.trackers.core.data.consistency import NORMAL
from trackwright.trackers.core.data.frames import text_lines
from trackwright.trackers.core.errors import UnusableInput, listed, one_or_more
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.calibration import RANGE_PRIOR
from trackwright.trackers.recordings.folder import FOLDERS, RecordingFolder
from trackwright.tuning.anchor_paths import (
    FEWEST,
    Prior,
    Solution,
    Walks,
    covariance_of,
    design_effect,
    multistart,
    solved,
    walks_of,
)
from trackwright.tuning.calibrating import check_at_rest

HIGHEST, ROUNDS = 1000.0, 3  # largest height of tags, m: others are in other units; rounds of effect and solution
# Deviation of exact positions, m; a frame's least height over base; ratio of log-likelihoods that excludes a place;
# deviation of walks from a plane, m, below which anchors may be on either side of it.
EXACT, ASIDE, UNLIKELY, FLAT = 1e-3, 0.1, 4.0, 0.15

COMMON_DELAY, OWN_DELAY = RANGE_PRIOR[1][0], 0.1  # sds of delays, m, before any range: of the shared, of each own
# Half-widths of 95 % intervals, m: the largest of determined and of weak coordinates, the least of unseen ones.
DETERMINED, WEAK, UNSEEN = 0.25, 1.0, 100.0
# Half-width of the 95 % interval, m, with which ranges determine a delay better than what was known before.
DELAY_DETERMINED = 0.7 * NORMAL * np.hypot(COMMON_DELAY, OWN_DELAY)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Survey:
    """Anchors with their positions and delays. `names` (A,); `positions` (A, 3) m; `delays` (A,) m; `covariance` (4A,
    4A), m²: of x, y, z and delay of each anchor in turn, zero where the frame or exact values fix them. `mirrored`
    (A,): whether the walks are in a plane, and nothing else says on which side of it the anchor is. `rms`, m, and
    `readings` (A,): of errors. `effect`: by how much errors that last widen variances. `paths`: positions (n, 3), m, of
    the tag in each walk. `rig`: from the first recording with these anchors, rounded to 0.1 mm. `notes`: what was
    assumed, a line each."""

    names: tuple[str, ...]
    positions: Float[np.ndarray, "A 3"]
    delays: Float[np.ndarray, " A"]
    covariance: Float[np.ndarray, "U U"]
    mirrored: Bool[np.ndarray, " A"]
    rms: Float[np.ndarray, " A"]
    readings: Int[np.ndarray, " A"]
    effect: float
    paths: tuple[Float[np.ndarray, "_ 3"], ...]
    rig: Rig
    notes: tuple[str, ...]

    head: ClassVar = ("anchor", "x, m", "y, m", "z, m", "delay, m", "rms, cm", "ranges", "verdict")

    @property
    def half_widths(self) -> Float[np.ndarray, "A 4"]:
        """Half-widths of the 95 % intervals of x, y, z and delay, m."""
        return NORMAL * np.sqrt(np.diag(self.covariance)).reshape(-1, 4)

    def block(self, k: int) -> Float[np.ndarray, "4 4"]:
        """The covariance of position and delay of anchor number `k`, m²."""
        return self.covariance[4 * k : 4 * k + 4, 4 * k : 4 * k + 4]

    def verdict(self, name: str) -> str:
        """Whether an anchor is determined, and otherwise what of it is not; raises UnusableInput for another name."""
        if name not in self.names:
            raise UnusableInput(f"{name!r}: no anchor of the survey; expected one of {listed(self.names, 12)}")
        k = self.names.index(name)
        what = ("x, y", "above or below the walk" if self.mirrored[k] else "height")
        unknown, weak = ([x for x, at in zip(what, self._extents(k), strict=True) if low < at <= high]
                         for low, high in ((WEAK, np.inf), (DETERMINED, WEAK)))  # fmt: skip
        words = (f"{how}: {', '.join(of)}" for how, of in (("not determined", unknown), ("weak", weak)) if of)
        return "; ".join(words) or "determined"

    def _extents(self, k: int) -> tuple[float, float]:
        """Half the largest horizontal axis of the 95 % interval of anchor `k`, and of its height, m."""
        flat = NORMAL * float(np.sqrt(np.linalg.eigvalsh(self.block(k)[:2, :2])[-1]))
        return flat, np.inf if self.mirrored[k] else float(self.half_widths[k, 2])

    def rows(self) -> list[list[str]]:
        """A row of `head` for each anchor; numbers that the walks do not determine in brackets."""
        rows, delays = [], self.half_widths[:, 3] < DELAY_DETERMINED
        for k, name in enumerate(self.names):
            over, height = (extent <= DETERMINED for extent in self._extents(k))
            known, values = (over, over, height, delays[k]), [*self.positions[k], self.delays[k]]
            cells = [_with_interval(*of) for of in zip(values, self.half_widths[k], known, strict=True)]
            rows.append([name, *cells, f"{100 * self.rms[k]:.1f}", str(self.readings[k]), self.verdict(name)])
        return rows

    @property
    def reading(self) -> str:
        """How to read the rows."""
        wide = f"{self.effect**0.5:.1f} times as wide as with independent errors"
        return f"± half the 95 % interval, {wide}; in parentheses: not determined."

    def __str__(self) -> str:
        rows = self.rows()
        lines = text_lines([row[:-1] for row in (list(self.head), *rows)], "<" + ">" * (len(self.head) - 2))
        verdicts = [f"{name}: {verdict}" for name, *_, verdict in rows]
        return "\n".join([f"Anchors of {self.rig.name}", "", *lines, "", *verdicts, "", self.reading])

    def __repr__(self) -> str:
        return f"<Survey of {len(self.names)} anchors from {len(self.paths)} walks; print it for a table>"


def _with_interval(value: float, half_width: float, known: bool) -> str:
    """A number and half of its interval, in brackets where it is not determined."""
    if half_width == 0.0:
        return f"{value:z.3f}"
    if half_width > UNSEEN:
        return "–"
    text = f"{value:z.2f}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{half_width:.2f}"
    return text if known else f"({text})"


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
    rig, d = folders[0].rig, 2 if np.isfinite(walks.heights).any() else 3
    known = np.array([rig.anchors.get(name, np.full(3, np.nan)) for name in names], float)
    random, before = np.random.default_rng(0), np.zeros((4 * len(names), 4 * len(names)))
    before[3::4, 3::4] = np.linalg.inv(OWN_DELAY**2 * np.eye(len(names)) + COMMON_DELAY**2)
    prior = Prior(np.zeros(len(before)), before, np.ones(len(before), bool))
    minima = multistart(walks, known, prior, random)
    words = "expected walks with ranges to four anchors within a second; walk where more anchors are heard"
    _require(minima, f"{listed(walks.names)}: no arrangement of the anchors fits the ranges; {words}")
    minima[0], prior, notes = framed(walks, minima[0], prior, d, names, known, given, sigma, frame)
    solution, effect = minima[0], 1.0
    for _ in range(ROUNDS):
        tempered = replace(prior, precision=prior.precision * effect)
        solution = solved(walks, solution, tempered)
        effect = design_effect(walks, solution, prior.free)
    sides = known[:, 2] if d == 2 or given else np.full(len(names), np.nan)
    solution, mirrored = sided(walks, solution, sides, prior.free[2::4])
    if mirrored.any():
        solution = solved(walks, solution, tempered)
        notes.append("the walks are in a plane, and anchors may be above or below it; walk at two heights")
    covariance = covariance_of(walks, solution, prior, effect)
    # Given positions are known as well as that, whatever other minima there are.
    searched = prior.free.reshape(-1, 4).copy()
    searched[[names.index(name) for name in given], :3] = False
    covariance += np.diag(searched.ravel() * between(minima, effect, d))
    places, at = solution.anchors[:, :3], walks.positions(solution.path)
    squares, readings = (np.bincount(walks.anchor, of) for of in (walks.errors(solution)[0] ** 2, None))
    # Heights of tags that differ from walk to walk are none of the rig.
    heights = {tag: {folder.rig.tags.get(tag, Tag()).height for folder in folders} for tag in rig.tags}
    tags = {k: replace(tag, height=None) if len(heights[k]) > 1 else tag for k, tag in rig.tags.items()}
    words = listed(f"{height:g} m" for height in np.unique(walks.heights[~np.isnan(walks.heights)]))
    words = f"heights of tags known: {words}" if words else "heights of tags estimated; --height states them"
    anchors = {**rig.anchors, **dict(zip(names, places.round(4) + 0.0, strict=True))}
    return Survey(
        names=tuple(names), positions=places, delays=solution.anchors[:, 3], covariance=covariance, mirrored=mirrored,
        rms=np.sqrt(squares / readings), readings=readings, effect=effect,
        paths=tuple(at[walks.walk == k] for k in range(len(walks.names))), rig=replace(rig, anchors=anchors, tags=tags),
        notes=(words, *notes),
    )  # fmt: skip


def _require(fits: object, words: str) -> None:
    if not fits:
        raise UnusableInput(words)


def _prepared(
    folders: Sequence[RecordingFolder], given: tuple[str, ...], sigma: float, frame: Sequence[str], height: float | None
) -> tuple[list[str], tuple[str, ...], Walks]:
    """The anchors, the given ones of them, and the walks; raises UnusableInput for what can't be surveyed."""
    where, rig, of_frame = listed(x.path or x.name for x in folders), folders[0].rig, f"frame {','.join(frame)}"
    fits = 0 <= sigma < np.inf and (given or not sigma)
    _require(fits, f"sigma {sigma:g}: belongs to given positions; expected metres, 0 if exact, and some named as given")
    _require(abs(height or 0.0) <= HIGHEST, f"height {height}: expected metres, {HIGHEST:g} at most; correct it")
    three = not frame or len({*frame}) == len(frame) == 3
    _require(three, f"{of_frame}: expected three different anchors, as A1,A2,A3")
    _require(not frame or not given, f"{of_frame}: given anchors are a frame; expected one of the two; leave one out")
    ranged = [folder for folder in folders if "ranges" in folder.tables]
    names = sorted({name for folder in ranged for name in folder.tables["ranges"]["anchor"].unique()})
    _require(len(names) >= 4, f"{where}: ranges to {len(names)} anchors; expected 4 at least; record more")
    given = tuple(names) if given == ("all",) else given
    for name in (*given, *frame):
        _require(name in names, f"anchor {name!r} has no readings; expected some of {listed(names, 12)}; correct it")
        words = f"{rig.name}: rig.toml has no anchor {name}; add the position of what is given"
        _require(name in frame or name in rig.anchors, words)
    walks = walks_of(ranged, names, height)
    seen = np.bincount(walks.anchor, minlength=len(names))
    words = f"{seen.min()} readings of {names[int(np.argmin(seen))]} without gaps; expected {FEWEST} at least"
    _require(seen.min() >= FEWEST, f"{where}: {words}; record a longer walk")
    # Given anchors stand at one place in all recordings.
    stated = [Rig(x.rig.name, anchors={k: x.rig.anchors[k] for k in given if k in x.rig.anchors}) for x in folders]
    check_at_rest([replace(folder, rig=of) for folder, of in zip(folders, stated, strict=True)])
    return names, given, walks


def aligned(points: np.ndarray, onto: np.ndarray, d: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The rotation or reflection (3, 3) and shift (3,) of d coordinates of points (k, 3) onto others (Kabsch 1976), two
    of a plane."""
    a, b = points[:, :d], onto[:, :d]
    left, sizes, right = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    for sign in (1.0, -1.0) if sizes[-1] < 1e-2 * sizes[0] else (1.0,):
        turn, shift = np.eye(3), np.zeros(3)
        turn[:d, :d] = (left * np.append(np.ones(d - 1), sign) @ right).T
        shift[:d] = b.mean(axis=0) - turn[:d, :d] @ a.mean(axis=0)
        yield turn, shift


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
    raise UnusableInput(f"{listed(frame or names)}: stand in a line; expected three that do not; choose a --frame")


def framed(
    walks: Walks, solution: Solution, prior: Prior, d: int, names: Sequence[str], known: np.ndarray,
    given: Sequence[str], sigma: float, frame: Sequence[str],
) -> tuple[Solution, Prior, list[str]]:  # fmt: skip
    """The solution among the given anchors or in the frame of three, the prior with what that fixes, and assumptions.

    `d`: the coordinates that are turned. `known` (A, 3): positions, m, of the given anchors, with standard deviation
    `sigma`, m.
    """
    free, mean, precision = prior.free.reshape(-1, 4).copy(), prior.mean.copy(), prior.precision
    anchors, target, notes = solution.anchors[:, :3], known.copy(), []
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
        if d == 3:
            notes.append("the mirror image of all, z as -z, fits as well; tags are assumed below the frame's anchors")
        if not frame:
            words = ", ".join(names[k] for k in chosen)
            notes.append(f"frame: {words}: origin, x axis, and to the left of it; --given or --frame choose another")
    placed, whole = [], np.zeros(len(walks.free))
    whole[walks.free] = solution.path
    for turn, shift in aligned(anchors[chosen], target[chosen], d):
        moved = np.column_stack([np.where(free[:, :3], anchors @ turn.T + shift, target), solution.anchors[:, 3]])
        path = (whole.reshape(-1, 3) @ turn.T + shift).ravel()[walks.free]
        placed.append(replace(solution, anchors=moved, path=path))
    # Of mirror images, that with the tags below the anchors.
    return min(placed, key=lambda s: walks.positions(s.path)[:, 2].mean()), Prior(mean, precision, free.ravel()), notes


def sided(
    walks: Walks, solution: Solution, heights: Float[np.ndarray, " A"], free: Bool[np.ndarray, " A"]
) -> tuple[Solution, Bool[np.ndarray, " A"]]:
    """The solution with anchors on the side of a level walk where their known `heights` are, else above it, and which
    may be on either side: those with `free` heights that are not known, of walks in a plane."""
    at, z = walks.positions(solution.path), solution.anchors[:, 2]
    if np.linalg.svd(at - at.mean(axis=0), compute_uv=False)[-1] >= FLAT * len(at) ** 0.5:
        return solution, np.zeros(len(z), bool)
    unknown, image = np.isnan(heights), 2.0 * at[:, 2].mean() - z
    other = np.where(unknown, image > z, np.abs(image - heights) < np.abs(z - heights))
    other &= free & np.isfinite(walks.heights).all()
    anchors = solution.anchors.copy()
    anchors[other, 2] = image[other]
    return replace(solution, anchors=anchors), free & unknown


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
