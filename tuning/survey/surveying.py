"""Surveys: where anchors or stations stand, from walks without truth, with intervals and verdicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from trackwright.trackers.core.errors import UnusableInput, listed, one_or_more
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.folder import FOLDERS, RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS
from trackwright.tuning.calibrating import check_at_rest
from trackwright.tuning.survey.anchors import Differences, Ranges
from trackwright.tuning.survey.result import Survey
from trackwright.tuning.survey.site import Site, SurveyedTable, W, names_of
from trackwright.tuning.survey.solving import design_effect
from trackwright.tuning.survey.stations import Bearings
from trackwright.tuning.survey.walks import LEAST_RANGES, Walk

TABLES: tuple[SurveyedTable, ...] = (Ranges(), Differences(), Bearings())
"""The tables that are surveyed with; the first that a recording has counts."""

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
    sigma_deg: float | None = None,
) -> Survey:
    """The positions of the anchors or stations of recordings without their truth, with delays or rotations.

    Ranges find anchors, range differences refine given positions of all anchors, with delays relative to their mean;
    bearings find the rotations of stations of which two at least are given, and the positions of others.

    `given`: anchors or stations whose positions in the rigs are known with standard deviation `sigma`, m; 0: exactly;
    or "all". `sigma_deg`: standard deviation, degrees, of the rotations of stations in the rigs; None: not known.
    Without any given, `frame` names three anchors: the origin, one on the x axis, one to the left of it and, where
    heights are not known, in the plane z = 0; by default the first two and the next aside. `height`: of all tags,
    m, else those that the rigs give; without either, heights are estimated. Raises UnusableInput where that does not
    fix the frame, for fewer than four anchors or two stations, and for walks to which no arrangement of them fits.
    """
    folders = one_or_more(recordings, (RecordingFolder,), FOLDERS)
    given, frame = (tuple(x.split(",") if isinstance(x, str) else x) for x in (given, frame))
    _require_sense(given, sigma, frame, height)
    table = table_of(folders)
    _require_rotations(table, frame, sigma_deg)
    names = _sensors_of(folders, table)
    given = names if given == ("all",) else given
    known = KINDS[table.name].places(folders[0].rig)
    _require_known(names, folders[0].rig.name, known, given, frame, KINDS[table.name].noun)
    walks = _long_enough(folders, names, height, table)
    places = np.array([known.get(name, np.full(3, np.nan)) for name in names], float)
    sigma_turn = None if sigma_deg is None else np.deg2rad(sigma_deg)
    site = Site(folders, names, walks, places, given, sigma, frame, sigma_turn)
    check_at_rest([replace(folder, rig=table.stated(site, folder.rig)) for folder in folders])
    random = np.random.default_rng(0)
    minima, prior = table.begun(site, random)
    solution, effect, tempered = minima[0], 1.0, prior
    for _ in range(ROUNDS):
        solution = table.solved(walks, solution, tempered, random)
        effect = design_effect(walks, solution, tempered)
        tempered = replace(prior, precision=prior.precision * effect)
    solution = table.settled(walks, solution, tempered)
    found = table.finished(site, solution, prior, effect, _notes(walks, site.flat), minima)
    return replace(found, rig=_of_every_walk(found.rig, folders))


def _of_every_walk(rig: Rig, folders: Sequence[RecordingFolder]) -> Rig:
    """The rig without the heights of tags that differ from walk to walk."""
    heights = {tag: {folder.rig.tags.get(tag, Tag()).height for folder in folders} for tag in rig.tags}
    return replace(
        rig, tags={k: replace(tag, height=None) if len(heights[k]) > 1 else tag for k, tag in rig.tags.items()}
    )


def table_of(folders: Sequence[RecordingFolder]) -> SurveyedTable:
    """The first of the tables that are surveyed with that a recording has; raises UnusableInput for none."""
    for table in TABLES:
        if any(table.name in folder.tables for folder in folders):
            return table
    raise UnusableInput(
        f"{names_of(folders)}: no table ranges, tdoa or bearings; expected one of them; give such a recording"
    )


def _sensors_of(folders: Sequence[RecordingFolder], table: SurveyedTable) -> list[str]:
    """The anchors or stations that have readings; raises UnusableInput for fewer than the table needs."""
    tables = [folder.tables[table.name] for folder in folders if table.name in folder.tables]
    kind = KINDS[table.name]
    names = sorted({name for rows in tables for column in kind.sensors for name in rows[column].unique()})
    if len(names) < table.least:
        raise UnusableInput(
            f"{names_of(folders)}: {kind.name} of {len(names)} {kind.noun}s; expected {table.least} at least; "
            "survey more"
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


def _require_rotations(table: SurveyedTable, frame: Sequence[str], sigma_deg: float | None) -> None:
    """Raises UnusableInput for rotations of anchors, and for a frame of stations."""
    if sigma_deg is not None and table.name != "bearings":
        raise UnusableInput(
            f"sigma_deg {sigma_deg:g}: is that of rotations of stations; expected bearings; leave it out"
        )
    if sigma_deg is not None and not 0 <= sigma_deg < 180:
        raise UnusableInput(f"sigma_deg {sigma_deg:g}: expected degrees, less than 180, or 0 for exact rotations")
    if frame and table.name == "bearings":
        raise UnusableInput(f"frame {','.join(frame)}: bearings have that of given stations; expected given; name two")


def _require_known(
    names: Sequence[str], rig: str, known: Mapping[str, object], given: Sequence[str], frame: Sequence[str], noun: str
) -> None:
    """Raises UnusableInput for anchors or stations without readings, and for given ones without a position."""
    for name in (*given, *frame):
        if name not in names:
            raise UnusableInput(
                f"{noun} {name!r} has no readings; expected some of {listed(names, 12)}; correct its id"
            )
    lacking = [name for name in (given if noun == "anchor" else names) if name not in known]
    if lacking:
        raise UnusableInput(f"{rig}: rig.toml has no {noun} {lacking[0]}; expected those given; add its position")


def _long_enough(
    folders: Sequence[RecordingFolder], names: Sequence[str], height: float | None, table: SurveyedTable[W]
) -> list[W]:
    """The walks; raises UnusableInput for an anchor or a station with too few readings."""
    walks = table.walks([folder for folder in folders if table.name in folder.tables], names, height)
    count = table.levels * len(names)
    by_level = sum((np.bincount(walk.levels.ravel(), minlength=count) for walk in walks), np.zeros(count, int))
    seen = by_level.reshape(len(names), -1).min(axis=1)
    if seen.min() < LEAST_RANGES:
        few = names[int(np.argmin(seen))]
        raise UnusableInput(
            f"{names_of(folders)}: {seen.min()} readings of {few} without gaps; expected {LEAST_RANGES} at least; "
            "record a longer walk"
        )
    return walks


def _notes(walks: Sequence[Walk], flat: bool) -> list[str]:
    """How heights enter."""
    if flat:
        heights = sorted({walk.height for walk in walks if walk.height is not None})
        known = f"heights of tags known: {listed(f'{height:g} m' for height in heights)}"
        free = dict.fromkeys(f"tag {walk.tag} of {walk.recording}" for walk in walks if walk.height is None)
        return [f"{known}; estimated: {listed(free)}" if free else known]
    return ["heights of tags estimated; --height states one that is known"]
