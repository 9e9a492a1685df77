"""Surveys: where the anchors of an installation stand, from walks without truth, with intervals and verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.trackers.core.data.consistency import NORMAL
from trackwright.trackers.core.errors import UnusableInput, listed, one_or_more
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.folder import FOLDERS, RecordingFolder
from trackwright.tuning.calibrating import check_at_rest
from trackwright.tuning.survey.result import COMMON_DELAY, OWN_DELAY, Survey
from trackwright.tuning.survey.solving import Prior, Solution, design_effect, information, predicted, solved
from trackwright.tuning.survey.starts import (
    FIRST_DENSITY,
    FIRST_SCALE,
    descended,
    misfit,
    multistart,
    polished,
    ranges_to,
)
from trackwright.tuning.survey.walks import LEAST_RANGES, LEVEL, Walk, common_height, walks_of

EXACT = 1e-3
"""Standard deviation, m, below which a given position counts as exact."""

CLOCK = 0.2
"""Standard deviation, m, of the offset of an anchor's clock before any range difference."""

UNLIKELY = 4.0
"""Log-likelihood ratio from which a mirror image is excluded."""

ASIDE = 0.1
"""Least distance of a frame's third anchor from the line through the others, as a share of their distance."""

LIFT = 1.0
"""Height over a walk, m, from which an anchor at its height is tried again."""

HIGHEST = 1000.0
"""Largest height of tags, m, that is taken for one: others are in other units."""

LEAST_ANCHORS = 4
ROUNDS = 3
"""How often the design effect, and the solution with it, are computed in turn."""


def survey(
    recordings: RecordingFolder | Sequence[RecordingFolder],
    given: Sequence[str] = (),
    sigma: float = 0.0,
    frame: Sequence[str] = (),
    height: float | None = None,
) -> Survey:
    """The positions and delays of the anchors of recordings with ranges or range differences, without their truth.

    Range differences refine given positions of all anchors; their delays are relative to the anchors' mean.

    `given`: anchors whose positions in the rigs are known with standard deviation `sigma`, m; 0: exactly; or "all".
    Without any, `frame` names three anchors: the origin, one on the x axis, one to the left of it and, where
    heights are not known, in the plane z = 0; by default the first two and the next aside. `height`: of all tags,
    m, else those that the rigs give; without either, heights are estimated. Raises UnusableInput where that does not
    fix the frame, for fewer than four anchors with ranges, and for walks to which no arrangement of them fits.
    """
    folders = one_or_more(recordings, (RecordingFolder,), FOLDERS)
    given, frame = (tuple(x.split(",") if isinstance(x, str) else x) for x in (given, frame))
    _require_sense(given, sigma, frame, height)
    before, table = folders[0].rig, _table_of(folders)
    names = _anchors_of(folders, table)
    given = names if given == ("all",) else given
    _require_known(names, before, given, frame)
    stated = [{name: f.rig.anchors[name] for name in given if name in f.rig.anchors} for f in folders]
    check_at_rest([replace(f, rig=Rig(f.name, anchors=a)) for f, a in zip(folders, stated, strict=True)])
    walks = _long_enough(folders, names, height, table)
    # One known height makes z the vertical.
    flat = any(walk.height is not None for walk in walks)
    notes = _notes(walks, flat)
    known = np.array([before.anchors.get(name, np.full(3, np.nan)) for name in names], float)
    differences = table == "tdoa"
    if differences and (len(given) < len(names) or not np.isfinite(known).all()):
        raise UnusableInput(
            f"{_names(folders)}: range differences refine positions of anchors that are roughly known; expected all of "
            "them in rig.toml; add them, and give all with their standard deviation"
        )
    prior, random = delay_prior(len(names), differences), np.random.default_rng(0)
    minima = [_tracked(folders, walks, known)] if differences else multistart(walks, known, prior, random)
    if not minima:
        raise UnusableInput(
            f"{_names(folders)}: no arrangement of the anchors fits the ranges; expected walks with ranges to four "
            "anchors within a second; walk where more anchors are heard"
        )
    solution, fixed = minima[0], [names.index(name) for name in given]
    if given:
        _require_frame(known[fixed], given)
        solution, prior = _onto(walks, solution, known, fixed, sigma, flat, prior)
    effect, tempered = 1.0, prior
    for _ in range(ROUNDS):
        solution = solved(walks, solution, tempered)
        # Anchors have a local minimum of their own in ranges; range differences start from given positions.
        solution = solution if differences else polished(walks, solution, tempered, random)
        effect = design_effect(walks, solution, tempered)
        tempered = replace(prior, precision=prior.precision * effect)
    if not differences:
        solution = min(_off_level(walks, solution, tempered), key=lambda s: s.cost)
    if not given:
        chosen = _axes(names, frame, solution.anchors[:, :3], 2 if flat else 3)
        solution, prior = _framed(walks, solution, chosen, flat, prior)
        words = ", ".join(names[k] for k in chosen)
        if not flat:
            notes.append("the mirror image of all, z as -z, fits as well; tags are assumed below the frame's anchors")
        if not frame:
            notes.append(f"frame: {words}: origin, x axis, and to the left of it; --given or --frame choose another")
    mirrored = np.zeros(len(names), bool)
    if not differences:
        sides = known if flat or given else None
        solution, mirrored = _sided(walks, solution, sides, prior.free.reshape(-1, 4), effect)
    covariance = _covariance(walks, solution, prior, effect)
    # Given positions are known as well as that, whatever other minima there are.
    searched = np.diag(covariance) > 0.0
    searched[[4 * k + axis for k in fixed for axis in range(3)]] = False
    covariance += np.diag(np.where(searched, _between(minima, effect, flat), 0.0))
    readings, rms = _residuals(walks, solution)
    positions = solution.anchors[:, :3]
    return Survey(
        tuple(names), positions, solution.anchors[:, 3], covariance, mirrored, solution.scales, solution.densities, rms,
        readings, effect, tuple(walk.positions(path) for walk, path in zip(walks, solution.paths, strict=True)),
        replace(before, anchors={**before.anchors, **dict(zip(names, positions, strict=True))}), before, tuple(notes),
    )  # fmt: skip


def _table_of(folders: Sequence[RecordingFolder]) -> str:
    """The table that is surveyed with: ranges, else range differences; raises UnusableInput for neither."""
    for name in ("ranges", "tdoa"):
        if any(name in folder.tables for folder in folders):
            return name
    raise UnusableInput(f"{_names(folders)}: no table ranges; expected ranges to anchors; give such a recording")


def _anchors_of(folders: Sequence[RecordingFolder], table: str) -> list[str]:
    """The anchors that have readings; raises UnusableInput for fewer than four."""
    tables = [folder.tables[table] for folder in folders if table in folder.tables]
    columns = [name for name in ("anchor", "anchor_2") if name in tables[0].columns]
    names = sorted({name for rows in tables for column in columns for name in rows[column].unique()})
    if len(names) < LEAST_ANCHORS:
        raise UnusableInput(
            f"{_names(folders)}: ranges to {len(names)} anchors; expected {LEAST_ANCHORS} at least; survey more"
        )
    return names


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


def _require_known(names: Sequence[str], rig: Rig, given: Sequence[str], frame: Sequence[str]) -> None:
    """Raises UnusableInput for anchors without ranges, and for given ones without a position."""
    for name in (*given, *frame):
        if name not in names:
            raise UnusableInput(f"anchor {name!r} has no ranges; expected some of {listed(names, 12)}; correct its id")
    lacking = [name for name in given if name not in rig.anchors]
    if lacking:
        raise UnusableInput(f"{rig.name}: rig.toml has no anchor {lacking[0]}; expected those given; add its position")


def _tracked(folders: Sequence[RecordingFolder], walks: Sequence[Walk], known: Float[np.ndarray, "A 3"]) -> Solution:
    """A start with the given anchors, and paths as the tracker of range differences has them there.

    Raises UnusableInput where nothing is tracked.
    """
    # jax takes a second to import, which a survey with ranges need not wait for.
    from trackwright.trackers.catalogue import build

    table = build("tdoa", folders).smoothing().run(folders).table
    paths = []
    for walk in walks:
        mine = (table["recording"] == walk.recording) & (table["tag"] == walk.tag)
        places = table.filter(mine).select("t_s", "x_m", "y_m", "z_m").drop_nulls(["x_m", "y_m"]).to_numpy()
        if not len(places):
            raise UnusableInput(f"{walk.recording}: tag {walk.tag} cannot be tracked; expected range differences of it")
        at = [np.interp(walk.times, places[:, 0], np.nan_to_num(column)) for column in places[:, 1:].T]
        paths.append(walk.fitted(np.stack(at, axis=1)))
    anchors = np.column_stack([known, np.zeros(len(known))])
    return Solution(anchors, paths, np.full(len(known), FIRST_SCALE), np.full(len(walks), FIRST_DENSITY))


def _long_enough(
    folders: Sequence[RecordingFolder], names: Sequence[str], height: float | None, table: str
) -> list[Walk]:
    """The walks; raises UnusableInput for an anchor with too few readings."""
    walks = walks_of([folder for folder in folders if table in folder.tables], names, height, table)
    seen = sum((np.bincount(walk.ends.ravel(), minlength=len(names)) for walk in walks), np.zeros(len(names), int))
    if seen.min() < LEAST_RANGES:
        few = names[int(np.argmin(seen))]
        raise UnusableInput(
            f"{_names(folders)}: {seen.min()} readings of {few} without gaps; expected {LEAST_RANGES} at least; "
            "record a longer walk"
        )
    return walks


def _residuals(walks: Sequence[Walk], solution: Solution) -> tuple[Int[np.ndarray, " A"], Float[np.ndarray, " A"]]:
    """The number of readings of each anchor, and the root mean square of their errors, m."""
    readings, squares = np.zeros(len(solution.anchors), int), np.zeros(len(solution.anchors))
    for walk, path in zip(walks, solution.paths, strict=True):
        error = walk.ranges - predicted(walk, solution.anchors, path)[0]
        for end in walk.ends.T:
            readings += np.bincount(end, minlength=len(readings))
            squares += np.bincount(end, error**2, len(readings))
    return readings, np.sqrt(squares / readings)


def _names(folders: Sequence[RecordingFolder]) -> str:
    return listed(str(folder.path or folder.name) for folder in folders)


def _notes(walks: Sequence[Walk], flat: bool) -> list[str]:
    """How heights enter."""
    if flat:
        heights = sorted({walk.height for walk in walks if walk.height is not None})
        known = f"heights of tags known: {listed(f'{height:g} m' for height in heights)}"
        free = dict.fromkeys(f"tag {walk.tag} of {walk.recording}" for walk in walks if walk.height is None)
        return [f"{known}; estimated: {listed(free)}" if free else known]
    return ["heights of tags estimated; --height states one that is known"]


def delay_prior(count: int, differences: bool = False) -> Prior:
    """Delays that share most of what they are, of range differences with a mean of zero; nothing about positions."""
    precision = np.zeros((4 * count, 4 * count))
    delays = np.arange(3, 4 * count, 4)
    if differences:
        # Clocks: their offsets are larger than delays of antennas. Their mean is in no difference.
        of_delays = np.eye(count) / CLOCK**2 + 1.0 / (count * EXACT) ** 2
    else:
        of_delays = np.linalg.inv(OWN_DELAY**2 * np.eye(count) + COMMON_DELAY**2)
    precision[np.ix_(delays, delays)] = of_delays
    return Prior(np.zeros(4 * count), precision, np.ones(4 * count, bool))


def _require_frame(places: np.ndarray, given: Sequence[str]) -> None:
    """Raises UnusableInput where given positions leave a rotation or a mirror image over the floor."""
    if len(places) < 3 or np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] < 0.1:
        words = "leave a rotation about their line; expected three that are not in one; give more"
        raise UnusableInput(f"given {','.join(given)}: {words}")


def _moved(walks: Sequence[Walk], solution: Solution, turn: np.ndarray, shift: np.ndarray) -> Solution:
    """The solution turned, or mirrored, by a matrix (3, 3) and shifted (3,)."""
    anchors = np.column_stack([solution.anchors[:, :3] @ turn.T + shift, solution.anchors[:, 3]])
    paths = [path @ turn[: w.dimensions, : w.dimensions].T + shift[: w.dimensions]
             for w, path in zip(walks, solution.paths, strict=True)]  # fmt: skip
    return replace(solution, anchors=anchors, paths=paths)


def aligned(points: np.ndarray, onto: np.ndarray, d: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """The rotation or reflection (3, 3) and shift (3,) of d coordinates of points (k, 3) onto others (Kabsch 1976).

    Two of them where the points are in a plane, which its mirror image fits as well.
    """
    a, b = points[:, :d], onto[:, :d]
    left, sizes, right = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    moves = []
    for sign in (1.0, -1.0) if sizes[-1] < 1e-2 * sizes[0] else (1.0,):
        turn, shift = np.eye(3), np.zeros(3)
        turn[:d, :d] = (left * np.append(np.ones(d - 1), sign) @ right).T
        shift[:d] = b.mean(axis=0) - turn[:d, :d] @ a.mean(axis=0)
        moves.append((turn, shift))
    return moves


def _onto(
    walks: Sequence[Walk],
    solution: Solution,
    known: np.ndarray,
    fixed: Sequence[int],
    sigma: float,
    flat: bool,
    prior: Prior,
) -> tuple[Solution, Prior]:
    """The solution among the given anchors, and their prior density beside that of delays, exact ones fixed."""
    mean, precision, free = prior.mean.copy(), prior.precision.copy(), prior.free.copy()
    moves = aligned(solution.anchors[fixed, :3], known[fixed], 2 if flat else 3)
    # Of mirror images, that with the tags below the given anchors.
    placed = min((_moved(walks, solution, *move) for move in moves), key=lambda s: _tags(walks, s)[:, 2].mean())
    anchors = placed.anchors.copy()
    for k in fixed:
        at = slice(4 * k, 4 * k + 3)
        mean[at] = known[k]
        if sigma < EXACT:
            free[at], anchors[k, :3] = False, known[k]
        else:
            precision[at, at] = np.eye(3) / sigma**2
    return replace(placed, anchors=anchors), Prior(mean, precision, free)


def _tags(walks: Sequence[Walk], solution: Solution) -> Float[np.ndarray, "n 3"]:
    """The positions of the tags, m, in all walks."""
    return np.concatenate([walk.positions(path) for walk, path in zip(walks, solution.paths, strict=True)])


def _axes(names: Sequence[str], frame: Sequence[str], anchors: np.ndarray, d: int) -> list[int]:
    """The anchors of the frame: those named, or the first two and the next one aside; refused in a line."""
    thirds = [names.index(frame[2])] if frame else range(2, len(names))
    a, b = (names.index(name) for name in (frame or names)[:2])
    ahead = (anchors[b] - anchors[a])[:d]
    for c in thirds:
        aside = (anchors[c] - anchors[a])[:d]
        off = np.linalg.norm(aside - ahead * (aside @ ahead) / (ahead @ ahead))
        if off > ASIDE * np.linalg.norm(ahead):
            return [a, b, c]
    words = ", ".join(frame or names)
    raise UnusableInput(f"{words}: stand in a line; expected three anchors that do not; give others as --frame")


def frame_of(
    anchors: Float[np.ndarray, "3 3"], tags: Float[np.ndarray, "n 3"], flat: bool
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]:
    """The rotation or reflection and the shift into the frame of three anchors, m, with tags below them.

    The first is the origin, the second on the x axis, the third to its left. `flat`: heights stay; otherwise the three
    have height 0.
    """
    d = 2 if flat else 3
    origin = anchors[0]
    ahead, aside = ((point - origin)[:d] for point in anchors[1:])
    x = ahead / np.linalg.norm(ahead)
    y = aside - x * (aside @ x)
    y /= np.linalg.norm(y)
    turn, shift = np.eye(3), np.zeros(3)
    turn[:d, :d] = np.stack([x, y] if flat else [x, y, np.cross(x, y)])
    if not flat and ((tags - origin) @ turn[2]).mean() > 0:
        turn[2] *= -1.0
    shift[:d] = -turn[:d, :d] @ origin[:d]
    return turn, shift


def _framed(
    walks: Sequence[Walk], solution: Solution, chosen: Sequence[int], flat: bool, prior: Prior
) -> tuple[Solution, Prior]:
    """The solution in the frame of three chosen anchors, and the prior with the coordinates that it fixes."""
    turn, shift = frame_of(solution.anchors[list(chosen), :3], _tags(walks, solution), flat)
    free = prior.free.copy().reshape(-1, 4)
    for k, first, last in zip(chosen, (0, 1, 2), (2, 2, 2) if flat else (3, 3, 3), strict=True):
        free[k, first:last] = False
    framed = _moved(walks, solution, turn, shift)
    return replace(framed, anchors=np.where(free, framed.anchors, 0.0)), replace(prior, free=free.ravel())


def _off_level(walks: Sequence[Walk], solution: Solution, prior: Prior) -> list[Solution]:
    """The solution, and that from a start with the anchors at the walk's height above it, where it has one.

    At that height the derivative by the height is zero: a fit stays there, whether or not it is best.
    """
    height, anchors = common_height(walks), solution.anchors.copy()
    level = prior.free[2::4] & (np.abs(anchors[:, 2] - (np.inf if height is None else height)) < LEVEL)
    anchors[level, 2] += LIFT
    starts = [solution, replace(solution, anchors=anchors)][: 1 + level.any()]
    return [solved(walks, start, prior) for start in starts]


def _sided(
    walks: Sequence[Walk], solution: Solution, known: np.ndarray | None, free: Bool[np.ndarray, "A 4"], effect: float
) -> tuple[Solution, Bool[np.ndarray, " A"]]:
    """The solution with anchors on the likely side of the walk's plane, and of which the other side fits as well.

    That side is where the rig has an anchor, `known` (A, 3), NaN where it does not, and otherwise above. Anchors whose
    heights are not `free` have no other side.
    """
    tags = _tags(walks, solution)
    centre = tags.mean(axis=0)
    normal = np.linalg.svd(tags[:: max(1, len(tags) // 2000)] - centre, full_matrices=False)[2][-1]
    anchors, mirrored = solution.anchors.copy(), np.zeros(len(solution.anchors), bool)
    for k in np.flatnonzero(free[:, 2]).tolist():
        anchor = solution.anchors[k]
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
    return replace(solution, anchors=anchors), mirrored


def _covariance(walks: Sequence[Walk], solution: Solution, prior: Prior, effect: float) -> Float[np.ndarray, "U U"]:
    """The covariance of what is free."""
    free = np.flatnonzero(prior.free)
    height, lifted = common_height(walks), solution.anchors.copy()
    if height is not None:
        # Ranges see the square of a height over the walk, whose derivative by that height vanishes at zero.
        over = lifted[:, 2] - height
        sizes = np.maximum(np.abs(over), LEVEL)
        lifted[:, 2] = height + np.copysign(sizes, over)
    precision = information(walks, replace(solution, anchors=lifted)) / effect + prior.precision
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
    best, d = minima[0].anchors, 2 if flat else 3
    variances = np.zeros_like(best)
    for other in minima[1:]:
        if (other.cost - minima[0].cost) / effect < UNLIKELY:
            moves = aligned(other.anchors[:, :3], best[:, :3], d)
            places = [other.anchors[:, :3] @ turn.T + shift for turn, shift in moves]
            away = min((place - best[:, :3] for place in places), key=lambda x: float((x[:, :d] ** 2).sum()))
            # A known height of tags leaves images above and below, which `mirrored` states.
            away[:, d:] = 0.0
            variances[:, :d] = np.maximum(variances[:, :d], (away**2).sum(axis=1)[:, None])
            variances[:, 3] = np.maximum(variances[:, 3], (other.anchors[:, 3] - best[:, 3]) ** 2)
    return variances.ravel()
