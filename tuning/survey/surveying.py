"""Surveys: where anchors stand, from ranges of walks without truth, with intervals and verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from trackwright.trackers.core.errors import UnusableInput, listed, one_or_more
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.folder import FOLDERS, RecordingFolder
from trackwright.tuning.calibrating import check_at_rest
from trackwright.tuning.survey.frames import between, covariance_of, framed, sided
from trackwright.tuning.survey.result import COMMON_DELAY, OWN_DELAY, Survey
from trackwright.tuning.survey.solving import Prior, design_effect, errors, solved
from trackwright.tuning.survey.starts import multistart, polished
from trackwright.tuning.survey.walks import LEAST_RANGES, Walks, walks_of

HIGHEST, ROUNDS = 1000.0, 3
"""Largest height of tags, m: others are in other units; how often the design effect and the solution are computed."""


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
        solution = polished(walks, solved(walks, solution, tempered), tempered, random)
        effect = design_effect(walks, solution, prior.free)
    sides = known if flat or given else np.full_like(known, np.nan)
    solution, mirrored = sided(walks, solution, sides, prior.free.reshape(-1, 4), effect)
    covariance = covariance_of(walks, solution, prior, effect)
    # Given positions are known as well as that, whatever other minima there are.
    searched = (np.diag(covariance) > 0.0).reshape(-1, 4)
    searched[[names.index(name) for name in given], :3] = False
    covariance += np.diag(np.where(searched.ravel(), between(minima, effect, 2 if flat else 3), 0.0))
    places, at = solution.anchors[:, :3], walks.positions(solution.path)
    squares, readings = (np.bincount(walks.anchor, of) for of in (errors(walks, solution)[0] ** 2, None))
    # Heights of tags that differ from walk to walk are none of the rig.
    heights = {tag: {folder.rig.tags.get(tag, Tag()).height for folder in folders} for tag in rig.tags}
    tags = {k: replace(tag, height=None) if len(heights[k]) > 1 else tag for k, tag in rig.tags.items()}
    anchors = {**rig.anchors, **dict(zip(names, places.round(4) + 0.0, strict=True))}
    return Survey(
        names=tuple(names), positions=places, delays=solution.anchors[:, 3], covariance=covariance, mirrored=mirrored,
        rms=np.sqrt(squares / readings), readings=readings, effect=effect,
        paths=tuple(at[walks.walk == k] for k in range(len(walks.names))), rig=replace(rig, anchors=anchors, tags=tags),
        notes=(_heights(walks), *notes),
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
    _require(0 <= sigma < np.inf, f"sigma {sigma:g}: expected metres above zero, or 0 for exact positions")
    _require(given or not sigma, f"sigma {sigma:g}: is that of given positions; expected some; name them as given")
    _require(
        height is None or abs(height) <= HIGHEST, f"height {height}: expected metres, {HIGHEST:g} at most; correct it"
    )
    _require(
        not frame or len({*frame}) == len(frame) == 3, f"{of_frame}: expected three different anchors, as A1,A2,A3"
    )
    _require(not frame or not given, f"{of_frame}: given anchors are a frame; expected one of the two; leave one out")
    ranged = [folder for folder in folders if "ranges" in folder.tables]
    _require(ranged, f"{where}: no table ranges; expected ranges of a tag to anchors; give such a recording")
    names = sorted({name for folder in ranged for name in folder.tables["ranges"]["anchor"].unique()})
    _require(len(names) >= 4, f"{where}: ranges of {len(names)} anchors; expected 4 at least; survey more")
    given = tuple(names) if given == ("all",) else given
    for name in (*given, *frame):
        known = listed(names, 12)
        _require(name in names, f"anchor {name!r} has no readings; expected some of {known}; correct its id")
    for name in given:
        _require(name in rig.anchors, f"{rig.name}: rig.toml has no anchor {name}; add the position of what is given")
    walks = walks_of(ranged, names, height)
    seen = np.bincount(walks.anchor, minlength=len(names))
    words = f"{seen.min()} readings of {names[int(np.argmin(seen))]} without gaps; expected {LEAST_RANGES} at least"
    _require(seen.min() >= LEAST_RANGES, f"{where}: {words}; record a longer walk")
    # Given anchors stand at one place in all recordings.
    stated = [Rig(x.rig.name, anchors={k: x.rig.anchors[k] for k in given if k in x.rig.anchors}) for x in folders]
    check_at_rest([replace(folder, rig=of) for folder, of in zip(folders, stated, strict=True)])
    return names, given, walks


def _heights(walks: Walks) -> str:
    """How heights of tags enter."""
    heights = np.unique(walks.heights[np.isfinite(walks.heights)]).tolist()
    if not heights:
        return "heights of tags estimated; --height states one that is known"
    free = dict.fromkeys(name for name, height in zip(walks.names, walks.heights, strict=True) if np.isnan(height))
    known = f"heights of tags known: {listed(f'{height:g} m' for height in heights)}"
    return f"{known}; estimated: {listed(free)}" if free else known
