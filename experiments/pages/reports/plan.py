"""The report of a plan: a table for the terminal, and a page whose anchors can be dragged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib import colormaps
from matplotlib.axes import Axes
from rich.table import Table

from trackwright.experiments.pages.charts.floor import bound_map
from trackwright.experiments.pages.charts.style import write_panels
from trackwright.experiments.pages.reports.pages import page, script_json, write_page
from trackwright.experiments.pages.reports.plan_accuracy import UNLIMITED, FloorMap, Placement, floor_of, minimised
from trackwright.experiments.text.tables import rendered, ruled_table
from trackwright.trackers.core.model.rig import Rig

COLOURS = 64
WIDTH = 80


QUANTITIES = {
    "flat": "horizontal, height known",
    "horizontal": "horizontal, height estimated",
    "vertical": "vertical",
    "spatial": "3-D",
}
"""The bounds of the page's script, and their words."""


def summary(floor: FloorMap, placement: Placement | None) -> dict[str, Any]:
    """The bounds over the floor, m, by name, the share of it where they are not determined, and proposed anchors."""
    content = {"height_m": floor.height, "sigmas": floor.sigmas._asdict(), "bounds": _figures(floor), "proposed": {}}
    if placement is not None:
        anchors = {name: position.tolist() for name, position in placement.anchors.items()}
        content["proposed"] = {"anchors": anchors, "bounds": _figures(placement.floor)}
    return content


def _figures(floor: FloorMap) -> dict[str, dict[str, Any]]:
    """The bounds over the floor, m, by name, and the share of it where they are not determined."""
    bounds = {}
    for name, bound in floor.bounds.items():
        cells = bound[floor.inside]
        determined = cells[np.isfinite(cells)]
        figures = (
            [np.sqrt(np.mean(determined**2)), *np.quantile(determined, (0.5, 0.95))] if len(determined) else [None] * 3
        )
        missing = 1 - len(determined) / max(len(cells), 1)
        bounds[name] = dict(zip(("rms_m", "median_m", "p95_m", "not_determined"), (*figures, missing), strict=True))
    return bounds


def summary_text(floor: FloorMap, placement: Placement | None, height_known: bool = False) -> str:
    """`summary` as tables without and with the proposed anchors, and these as lines for rig.toml."""
    title = f"Bound of one epoch, tags at {floor.height:g} m"
    if placement is None:
        return rendered(WIDTH, _table(title, floor))
    names = ", ".join(placement.anchors)
    lines = [f"Proposed, for the least bound ({minimised(height_known)}, RMS over the floor):"]
    lines += [f"  {name} = [{x:.2f}, {y:.2f}, {z:.2f}]" for name, (x, y, z) in placement.anchors.items()]
    tables = _table(f"{title}, as in rig.toml", floor), _table(f"{title}, with {names}", placement.floor)
    return rendered(WIDTH, *tables, *lines)


def _table(title: str, floor: FloorMap) -> Table:
    table = ruled_table(title, ("bound", "RMS, cm", "median, cm", "95 %, cm", "not determined"))
    for name, figures in _figures(floor).items():
        cells = (
            "-" if x is None else f"{100 * x:.3g}" for x in (figures[key] for key in ("rms_m", "median_m", "p95_m"))
        )
        table.add_row(name, *cells, f"{100 * (figures['not_determined']):.0f} %")
    return table


def plan_data(rig: Rig, floor: FloorMap, proposed: Mapping[str, np.ndarray]) -> dict[str, Any]:
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
        "proposed": [{"id": name, "position": position.tolist()} for name, position in proposed.items()],
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


def write_bound_maps(path: Path, rig: Rig, floor: FloorMap, proposed: Mapping[str, np.ndarray]) -> Path:
    """Writes a map of each bound, with anchors, stations and proposed anchors (3,), m, whole or not at all."""
    fields = {name: bound for name, bound in floor.bounds.items() if np.any(np.isfinite(bound))}
    whole = replace(rig, anchors={**rig.anchors, **proposed})
    maps = [
        partial(bound_map, x=floor.x, y=floor.y, bound=bound, name=name, rig=whole, proposed=proposed)
        for name, bound in fields.items()
    ]
    tall = float(np.clip(np.ptp(floor.y) / np.ptp(floor.x), 0.35, 1.6))
    size = 3.4 * max(len(maps), 1) + 0.4, 3.2 * tall + 1.8
    title = f"{rig.name}: bound of one epoch" + (f", with {', '.join(proposed)}" if proposed else "")
    return write_panels(path, maps or [Axes.set_axis_off], size, title, max(len(maps), 1), sharey=True)


def write_plan(
    path: Path,
    rig: Rig,
    floor: FloorMap,
    proposed: Mapping[str, np.ndarray],
    command: Sequence[str],
    height_known: bool = False,
) -> Path:
    """Writes the page whole or not at all; returns its path.

    `floor`: its grid and height are the page's. `proposed`: anchors (3,), m, with which the page opens.
    """
    data = Markup(script_json(plan_data(rig, floor, proposed)))
    text = page(
        "plan.html", command, title=rig.name, data=data, sigmas=floor.sigmas, height=floor.height,
        anchors=len(rig.anchors), stations=len(rig.stations), quantities=QUANTITIES, opened=minimised(height_known),
    )  # fmt: skip
    return write_page(path, text)
