"""Surveys: where anchors stand, from ranges of walks without truth, with intervals and verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from trackwright.trackers.core.errors import UnusableInput, listed, one_or_more
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.folder import FOLDERS, RecordingFolder
from trackwright.tuning.calibrating import check_at_rest
from trackwright.tuning.survey.frames import framed, onto, require_frame
from trackwright.tuning.survey.result import COMMON_DELAY, OWN_DELAY, Survey
from trackwright.tuning.survey.sides import between, covariance_of, off_level, sided
from trackwright.tuning.survey.solving import Prior, design_effect, solved
from trackwright.tuning.survey.starts import multistart, polished
from trackwright.tuning.survey.walks import LEAST_RANGES, Walk, walks_of

HIGHEST = 1000.0
"""Largest height of tags, m, that is taken for one: others are in other units."""

ROUNDS = 3
"""How often the design effect, and the solution with it, are computed in turn."""


def survey(
    recordings: RecordingFolder | Sequence[RecordingFolder],
    given: Sequence[str] = (),
    sigma: float = 0.0,
    frame: Sequence[str] = (),
    height: float | None = None,
) -> Survey:
    """The positions and delays of the anchors of recordings with ranges, without their truth.

    `given`: anchors whose positions in the rigs are known with standard deviation `sigma`, m; 0: exactly; or "all".
    Without any given, `frame` names three anchors: the origin, one on the x axis, one to the left of it and, where
    heights are not known, in the plane z = 0; by default the first two and the next aside. `height`: of all tags,
    m, else those that the rigs give; without either, heights are estimated. Raises UnusableInput where that does not
    fix the frame, for fewer than four anchors, and for walks to which no arrangement of them fits.
    """
    folders = one_or_more(recordings, (RecordingFolder,), FOLDERS)
    given, frame = (tuple(x.split(",") if isinstance(x, str) else x) for x in (given, frame))
    _require_sense(given, sigma, frame, height)
    where, rig = listed(str(folder.path or folder.name) for folder in folders), folders[0].rig
    tables = [folder.tables["ranges"] for folder in folders if "ranges" in folder.tables]
    if not tables:
        raise UnusableInput(f"{where}: no table ranges; expected ranges of a tag to anchors; give such a recording")
    names = sorted({name for rows in tables for name in rows["anchor"].unique()})
    if len(names) < 4:
        raise UnusableInput(f"{where}: ranges of {len(names)} anchors; expected 4 at least; survey more")
    given = tuple(names) if given == ("all",) else given
    for name in (*given, *frame):
        if name not in names:
            raise UnusableInput(
                f"anchor {name!r} has no readings; expected some of {listed(names, 12)}; correct its id"
            )
    if lacking := [name for name in given if name not in rig.anchors]:
        raise UnusableInput(f"{rig.name}: rig.toml has no anchor {lacking[0]}; expected those given; add its position")
    walks = walks_of([folder for folder in folders if "ranges" in folder.tables], names, height)
    seen = sum((np.bincount(walk.anchor, minlength=len(names)) for walk in walks), np.zeros(len(names), int))
    if seen.min() < LEAST_RANGES:
        raise UnusableInput(
            f"{where}: {seen.min()} readings of {names[int(np.argmin(seen))]} without gaps; expected {LEAST_RANGES} at "
            "least; record a longer walk"
        )
    # Given anchors stand at one place in all recordings.
    stated = [Rig(x.rig.name, anchors={k: x.rig.anchors[k] for k in given if k in x.rig.anchors}) for x in folders]
    check_at_rest([replace(folder, rig=of) for folder, of in zip(folders, stated, strict=True)])

    known = np.array([rig.anchors.get(name, np.full(3, np.nan)) for name in names], float)
    fixed, flat = [names.index(name) for name in given], any(walk.height is not None for walk in walks)
    random, prior = np.random.default_rng(0), delays_before(len(names))
    minima = multistart(walks, known, prior, random)
    if not minima:
        raise UnusableInput(
            f"{where}: no arrangement of the anchors fits the ranges; expected walks with ranges to four anchors "
            "within a second; walk where more anchors are heard"
        )
    if given:
        require_frame(known[fixed], given)
        minima[0], prior = onto(walks, minima[0], known, fixed, sigma, flat, prior)
    solution, effect, tempered = minima[0], 1.0, prior
    for _ in range(ROUNDS):
        solution = polished(walks, solved(walks, solution, tempered), tempered, random)
        effect = design_effect(walks, solution, tempered)
        tempered = replace(prior, precision=prior.precision * effect)
    solution, notes = off_level(walks, solution, tempered), _notes(walks, flat)
    if not given:
        solution, prior, words = framed(walks, solution, names, frame, flat, prior)
        notes += words
    sides = known if flat or given else None
    solution, mirrored = sided(walks, solution, sides, prior.free.reshape(-1, 4), effect)
    covariance = covariance_of(walks, solution, prior, effect)
    # Given positions are known as well as that, whatever other minima there are.
    searched = np.diag(covariance) > 0.0
    searched[[4 * k + axis for k in fixed for axis in range(3)]] = False
    covariance += np.diag(np.where(searched, between(minima, effect, flat), 0.0))
    anchor = np.concatenate([walk.anchor for walk in walks])
    pairs = list(zip(walks, solution.paths, strict=True))
    errors = np.concatenate([walk.linearised(solution.anchors, path)[0] for walk, path in pairs])
    places = solution.anchors[:, :3]
    anchors = {**rig.anchors, **dict(zip(names, places.round(4) + 0.0, strict=True))}
    return Survey(
        names=tuple(names), positions=places, delays=solution.anchors[:, 3], covariance=covariance, mirrored=mirrored,
        scales=solution.scales, densities=solution.densities, rms=np.sqrt(np.bincount(anchor, errors**2) / seen),
        readings=seen, effect=effect, paths=tuple(walk.positions(path) for walk, path in pairs),
        rig=_of_every_walk(replace(rig, anchors=anchors), folders), notes=tuple(notes),
    )  # fmt: skip


def delays_before(count: int) -> Prior:
    """The density of the delays of so many anchors before any range, and nothing about positions."""
    whole = np.zeros((4 * count, 4 * count))
    whole[3::4, 3::4] = np.linalg.inv(OWN_DELAY**2 * np.eye(count) + COMMON_DELAY**2)
    return Prior(np.zeros(4 * count), whole, np.ones(4 * count, bool))


def _of_every_walk(rig: Rig, folders: Sequence[RecordingFolder]) -> Rig:
    """The rig without the heights of tags that differ from walk to walk."""
    heights = {tag: {folder.rig.tags.get(tag, Tag()).height for folder in folders} for tag in rig.tags}
    tags = {k: replace(tag, height=None) if len(heights[k]) > 1 else tag for k, tag in rig.tags.items()}
    return replace(rig, tags=tags)


def _require_sense(given: Sequence[str], sigma: float, frame: Sequence[str], height: float | None) -> None:
    """Raises UnusableInput for values that are none, and for arguments that exclude each other."""
    if not 0 <= sigma < np.inf:
        raise UnusableInput(f"sigma {sigma:g}: expected metres above zero, or 0 for exact positions")
    if sigma and not given:
        raise UnusableInput(f"sigma {sigma:g}: is that of given positions, and none are; name them as given, or all")
    if height is not None and not abs(height) <= HIGHEST:
        raise UnusableInput(f"height {height:g}: expected metres, {HIGHEST:g} at most; correct the height of the tags")
    if frame and not len(frame) == len(set(frame)) == 3:
        raise UnusableInput(f"frame {','.join(frame)}: expected three different anchors, as A1,A2,A3; name three")
    if frame and given:
        raise UnusableInput(
            f"frame {','.join(frame)}: given anchors are a frame; expected one of the two; leave one out"
        )


def _notes(walks: Sequence[Walk], flat: bool) -> list[str]:
    """How heights enter."""
    if not flat:
        return ["heights of tags estimated; --height states one that is known"]
    heights = sorted({walk.height for walk in walks if walk.height is not None})
    known = f"heights of tags known: {listed(f'{height:g} m' for height in heights)}"
    free = dict.fromkeys(f"tag {walk.tag} of {walk.recording}" for walk in walks if walk.height is None)
    return [f"{known}; estimated: {listed(free)}" if free else known]
