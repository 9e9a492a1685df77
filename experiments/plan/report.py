"""The report of a plan: a table for the terminal, and a page whose anchors can be dragged."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from markupsafe import Markup
from matplotlib import colormaps

from experiments.interactive.packing import script_json
from experiments.plan.accuracy import UNLIMITED, FloorMap, floor_of
from experiments.plan.placement import Placement
from experiments.reports.pages import page, write_page
from experiments.reports.tables import rendered, ruled_table
from trackers.core.rig import Rig

COLOURS = 64
WIDTH = 80


def summary(floor: FloorMap, placement: Placement | None) -> dict[str, Any]:
    """The bounds over the floor, m, by name, the share of it where they are not determined, and proposed anchors."""
    bounds = {}
    for name, bound in floor.bounds.items():
        cells = bound[floor.inside]
        found = cells[np.isfinite(cells)]
        figures = [np.sqrt(np.mean(found**2)), *np.quantile(found, (0.5, 0.95))] if len(found) else [None] * 3
        missing = 1 - len(found) / max(len(cells), 1)
        bounds[name] = dict(zip(("rms_m", "median_m", "p95_m", "not_determined"), (*figures, missing), strict=True))
    proposed = {}
    if placement is not None:
        before = placement.before if placement.before < UNLIMITED else None
        proposed = {"anchors": placement.positions.tolist(), "before_m": before, "after_m": placement.after}
    return {"height_m": floor.height, "sigmas": floor.sigmas._asdict(), "bounds": bounds, "proposed": proposed}


def summary_text(floor: FloorMap, placement: Placement | None) -> str:
    """`summary` as a table, and the proposed anchors as lines for rig.toml."""
    table = ruled_table(
        f"Bound of one epoch, tags at {floor.height:g} m",
        ("bound", "RMS, cm", "median, cm", "95 %, cm", "not determined"),
    )
    content = summary(floor, placement)
    for name, figures in content["bounds"].items():
        cells = [figures[key] for key in ("rms_m", "median_m", "p95_m")]
        table.add_row(
            name, *("-" if x is None else f"{100 * x:.3g}" for x in cells), f"{100 * figures['not_determined']:.0f} %"
        )
    lines, proposed = [], content["proposed"]
    if proposed:
        before = "no determined position" if proposed["before_m"] is None else f"{100 * proposed['before_m']:.3g} cm"
        lines = [
            f"Proposed anchors, with which the bound goes from {before} to {100 * proposed['after_m']:.3g} cm RMS:"
        ]
        lines += [f"  P{k + 1} = [{x:.2f}, {y:.2f}, {z:.2f}]" for k, (x, y, z) in enumerate(proposed["anchors"])]
    return rendered(WIDTH, table, *lines)


def plan_data(rig: Rig, floor: FloorMap, proposed: Float[np.ndarray, "n 3"]) -> dict[str, Any]:
    """The data of the page's script: geometry and grid in metres, standard deviations, colours."""
    stations = [
        {
            "id": name,
            "position": station.position.tolist(),
            "axes": station.world_from_array().T.tolist(),
            "antennas": None if station.antennas is None else np.asarray(station.antennas).tolist(),
            "wavelength": station.wavelength,
        }
        for name, station in rig.stations.items()
    ]
    return {
        "anchors": [{"id": name, "position": np.asarray(p).tolist()} for name, p in rig.anchors.items()],
        "stations": stations,
        "proposed": proposed.tolist(),
        "outline": floor_of(rig).tolist(),
        "walls": rig.all_walls().tolist(),
        "x": floor.x.tolist(),
        "y": floor.y.tolist(),
        "inside": floor.inside.astype(int).tolist(),
        "height": floor.height,
        "sigmas": floor.sigmas._asdict(),
        "unlimited": UNLIMITED,
        "colours": np.round(255 * colormaps["viridis_r"](np.linspace(0, 1, COLOURS))[:, :3]).astype(int).tolist(),
    }


def write_plan(
    path: Path, rig: Rig, floor: FloorMap, proposed: Float[np.ndarray, "n 3"], command: Sequence[str]
) -> Path:
    """Writes the page whole or not at all; returns its path."""
    data = Markup(script_json(plan_data(rig, floor, proposed)))
    text = page(
        "plan.html", title=rig.name, data=data, sigmas=floor.sigmas, height=floor.height, anchors=len(rig.anchors),
        stations=len(rig.stations), words=shlex.join(["trackwright", *command[1:]]), proposed=len(proposed),
    )  # fmt: skip
    return write_page(path, text)
