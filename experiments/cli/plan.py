"""`trackwright plan`."""

from __future__ import annotations

import math
import sys
from pathlib import Path

from trackwright.experiments.cli.options import FigureFormat, Folder
from trackwright.trackers.core.errors import UnusableInput

HEIGHT = 1.2


def plan(
    rig: Path,
    /,
    *,
    out: Folder,
    height: float | None = None,
    sigma_range: float = 0.1,
    sigma_angle: float = 0.05,
    sigma_phase: float = 0.3,
    sigma_difference: float | None = None,
    place: int = 0,
    format: FigureFormat = "png",
    json: bool = False,
) -> int:
    """Plan an installation: maps of the bound of errors over its floor.

    Before anything is recorded: the Cramér–Rao bound of the position from one epoch, a reading of every anchor and
    station. Writes plan.html, whose anchors and stations can be dragged, and the figure plan.png.

    Args:
        rig: a rig.toml with anchors or stations, or the folder that holds it.
        out: the folder to write to.
        height: of the tags, m, known to the tracker; default: that of the tags in rig.toml, else 1.2 m and estimated.
        sigma_range: standard deviation of a range, m.
        sigma_angle: standard deviation of an azimuth or elevation, rad.
        sigma_phase: standard deviation of a phase, rad.
        sigma_difference: standard deviation of a range difference (TDoA), m, which anchors give instead of ranges.
        place: propose places on the outline of the floor for so many more anchors.
        format: of the figure, plan.png or plan.pdf.
        json: print the bounds, m, and proposed anchors as JSON instead of a table.
    """
    sigmas = {"range": sigma_range, "angle": sigma_angle, "phase": sigma_phase, "difference": sigma_difference}
    for name, sigma in sigmas.items():
        if sigma is not None and not 0 < sigma < math.inf:
            raise UnusableInput(f"--sigma-{name} {sigma:g}: expected a number above zero")
    if not 0 <= place <= 8:
        raise UnusableInput(f"--place {place}: expected a number of anchors from 0 to 8")
    if height is not None and not math.isfinite(height):
        raise UnusableInput(f"--height {height:g}: expected a height in metres")
    from trackwright.experiments.cli.console import json_alone, output_folder
    from trackwright.experiments.text.terminal import notice
    from trackwright.trackers.recordings.rig_file import RIG_FILE, read_rig

    geometry, notices = read_rig(rig / RIG_FILE if rig.is_dir() else rig)
    for text in notices:
        notice(f"notice: {rig}: {text}")
    heights = {tag.height for tag in geometry.tags.values() if tag.height is not None}
    known = height is not None or bool(heights)
    if height is None:
        height = sum(heights) / len(heights) if heights else HEIGHT
    output_folder(out)
    # jax takes a second to import, which the help and a refused rig need not wait for.
    from trackwright.experiments.pages.reports.plan import summary, summary_text, write_bound_maps, write_plan
    from trackwright.experiments.pages.reports.plan_accuracy import Sigmas, floor_map, place_anchors

    floor = floor_map(geometry, Sigmas(sigma_range, sigma_angle, sigma_phase, sigma_difference), height)
    placement = place_anchors(geometry, place, floor, known) if place else None
    proposed, planned = ({}, floor) if placement is None else placement
    drawn = out / f"plan.{format}"
    write_bound_maps(drawn, geometry, planned, proposed)
    page = write_plan(out / "plan.html", geometry, planned, proposed, sys.argv, known)
    with json_alone(json) as put:
        print(summary_text(floor, placement, known), end="")
        print(f"wrote {page} and {drawn.name}")
        put(summary(floor, placement))
    return 0
