"""`trackwright trackers`: what can be run, and which of its numbers can be set or fitted."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trackwright.experiments.cli.arguments import rows
from trackwright.experiments.cli.options import Tracker, run_tracker_files
from trackwright.trackers.catalogue import ENTRIES
from trackwright.trackers.core.errors import UnusableInput

if TYPE_CHECKING:
    import numpy as np

    from trackwright.trackers.recordings.folder import RecordingFolder
    from trackwright.trackers.recordings.named_tracker import NamedTracker


def trackers(tracker: Tracker | None = None, folder: Path | None = None, /, *, json: bool = False) -> int:
    """List the trackers and the tables they read; the tunables of one.

    The first that fits the tables of a recording is chosen where none is named. A tracker of your own is a Python file:
    --tracker FILE.py:NAME.

    Tunables, with value, unit, bounds and meaning, have the names of --set, --tune, --bound and --over; those with a
    star are fitted where --tune names none.

    Args:
        tracker: one of the list, or FILE.py:NAME of a TrackerSpec of your own, whose tunables are listed.
        folder: a recording folder, whose stations or anchors it gets; default: a simulated one that it fits.
        json: print JSON instead of lines.
    """
    if tracker is not None:
        return _list_tunables(tracker, folder, json)
    listed = {name: f"{entry.about} ({entry.table})" for name, entry in ENTRIES.items()}
    if json:
        # polars takes 0.1 s to import.
        from trackwright.trackers.recordings.atomic import json_text

        print(json_text(listed), end="")
    else:
        print("\n".join(rows(listed.items(), 29)))
    return 0


def _list_tunables(tracker: str, folder: Path | None, json: bool) -> int:
    from trackwright.experiments.cli.console import read_with_notices
    from trackwright.experiments.text.tables import terminal_width
    from trackwright.experiments.text.terminal import notice
    from trackwright.trackers.recordings.atomic import json_text

    run_tracker_files(tracker)
    folders = [] if folder is None else read_with_notices((folder,))
    # jax takes a second to import, which the help and a refused recording need not wait for.
    from trackwright.trackers.catalogue import build, spec_of

    recording = folders[0] if folders else _simulated(tracker, spec_of(tracker).missing)
    listed = _rows(build(tracker, recording))
    if json:
        print(json_text({"tracker": tracker, "recording": recording.name, "tunables": listed}))
        return 0
    if not folders:
        notice(f"values: of the simulated recording {recording.name}; give a recording FOLDER for its own")
    print(_table(listed, terminal_width()), end="")
    return 0


def _simulated(tracker: str, missing: Any) -> RecordingFolder:
    """A simulated recording that has what the tracker needs; raises UnusableInput where there is none."""
    for folder in _simulated_folders():
        if missing(folder) is None:
            return folder
    raise UnusableInput(f"trackers {tracker}: no simulated recording has what it reads; give a recording FOLDER")


def _simulated_folders() -> Iterator[RecordingFolder]:
    """A recording of each world: as it is, with a floor and heights, and with bearings; and differences with an IMU."""
    import numpy as np
    import polars as pl

    from trackwright.sim.worlds import WORLDS, tdoa
    from trackwright.trackers.core.model.rig import Tag

    for world in WORLDS.values():
        folder = world(np.arange(1), 0)
        yield folder
        truth = folder.tables["truth"]
        x, y, z = (truth[axis].to_numpy() for axis in ("x_m", "y_m", "z_m"))
        (west, east), (south, north) = ((v.min() - 1, v.max() + 1) for v in (x, y))
        outline = np.array([[west, south], [east, south], [east, north], [west, north]])
        tags = {tag: Tag(float(z[0])) for tag in truth["tag"].unique()}
        yield replace(folder, rig=replace(folder.rig, outline=outline, tags=tags))
        angles = {name: s.angles(np.stack([x, y, z], axis=1)).T for name, s in folder.rig.stations.items()}
        at = truth.select("t_s", "tag")
        seen = [at.with_columns(station=pl.lit(k), azimuth_rad=a, elevation_rad=e) for k, (a, e) in angles.items()]
        if seen:
            yield replace(folder, tables={"bearings": pl.concat(seen).sort("t_s"), "truth": truth})
    yield tdoa(1, imu=True).folder()


def _rows(named: NamedTracker) -> list[dict[str, Any]]:
    import numpy as np

    from trackwright.trackers.core.model.tunable import meanings
    from trackwright.tuning.parameters import noise_levels

    sentences = meanings(named.tracker)
    try:
        fitted = noise_levels(named.tracker)
    except UnusableInput:
        fitted = ()
    return [
        {
            "name": name,
            "value": np.asarray(node.value, float).tolist(),
            "unit": node.unit,
            "bounds": node.bounds,
            "fitted_by_default": name in fitted,
            "meaning": sentences[name],
        }
        for name, node in named.tunables.items()
    ]


def _table(listed: list[dict[str, Any]], width: int) -> str:
    """A line for each tunable, and below them, where they mean one thing, what it is."""
    import numpy as np

    from trackwright.experiments.text.tables import aligned

    rows = [("tunable", "value", "unit", "bounds")]
    for tunable in listed:
        star, unit = "*" if tunable["fitted_by_default"] else "", "" if tunable["unit"] == "1" else tunable["unit"]
        rows.append((tunable["name"] + star, _short(np.asarray(tunable["value"])), unit, tunable["bounds"]))
    head, *lines = aligned(rows).splitlines()
    text = [head]
    for k, (line, tunable) in enumerate(zip(lines, listed, strict=True)):
        text.append(line.rstrip())
        last = k + 1 == len(listed) or listed[k + 1]["meaning"] != tunable["meaning"]
        if last and tunable["meaning"]:
            indent = "    "
            text += textwrap.wrap(tunable["meaning"], width, initial_indent=indent, subsequent_indent=indent)
    return "\n".join(text) + "\n"


def _short(value: np.ndarray) -> str:
    """A number, a few, or their count and span."""
    numbers = sorted(set(value.ravel().tolist()))
    if value.size <= 3:
        return ", ".join(f"{number:.4g}" for number in value.ravel())
    shape = " x ".join(map(str, value.shape))
    return f"{shape}: {numbers[0]:.4g}" + (f" to {numbers[-1]:.4g}" if len(numbers) > 1 else "")
