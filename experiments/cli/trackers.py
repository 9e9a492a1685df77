"""`trackwright trackers`: what can be run, and which of its numbers can be set or fitted."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

from trackwright.experiments.cli.commands import rows
from trackwright.experiments.cli.options import Readings, Tracker
from trackwright.trackers.catalogue import ENTRIES, run_files
from trackwright.trackers.core.errors import UnusableInput


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
    if tracker is None:
        listed = {name: f"{entry.about} ({entry.table})" for name, entry in ENTRIES.items()}
        if not json:
            print("\n".join(rows(listed.items(), 29)))
            return 0
    # polars takes 0.1 s to import.
    from trackwright.trackers.recordings.atomic import json_text

    if tracker is None:
        print(json_text(listed), end="")
        return 0
    from trackwright.experiments.cli.console import prepared
    from trackwright.experiments.text.tables import terminal_width
    from trackwright.experiments.text.terminal import notice

    run_files(tracker)
    folders = [] if folder is None else prepared((folder,), Readings(), check=False)
    # jax takes a second to import, which the help and a refused recording need not wait for.
    from trackwright.experiments.cli.examples import example_for
    from trackwright.trackers.catalogue import build, spec_of

    recording = folders[0] if folders else example_for(spec_of(tracker))
    if recording is None:
        raise UnusableInput(f"trackers {tracker}: no simulated recording has what it reads; give a recording FOLDER")
    tunables = described(build(tracker, recording))
    if json:
        plain = [{name: one[name] for name in one if name != "text"} for one in tunables]
        print(json_text({"tracker": tracker, "recording": recording.name, "tunables": plain}))
        return 0
    if not folders:
        notice(f"values: of the simulated recording {recording.name}; give a recording FOLDER for its own")
    print(_table(tunables, terminal_width()), end="")
    return 0


def _table(tunables: list[dict[str, Any]], width: int) -> str:
    """A line for each tunable, and below them, where they mean one thing, what it is."""
    from trackwright.experiments.text.tables import aligned

    cells = [("tunable", "value", "unit", "bounds")]
    for one in tunables:
        star, unit = "*" if one["fitted_by_default"] else "", "" if one["unit"] == "1" else one["unit"]
        cells.append((one["name"] + star, one["text"], unit, one["bounds"]))
    head, *lines = aligned(cells).splitlines()
    text = [head]
    for line, one, following in zip(lines, tunables, [*tunables[1:], {"meaning": None}], strict=True):
        text.append(line.rstrip())
        if following["meaning"] != one["meaning"] and one["meaning"]:
            text += textwrap.wrap(one["meaning"], width, initial_indent="    ", subsequent_indent="    ")
    return "\n".join(text) + "\n"


def described(named: Any) -> list[dict[str, Any]]:
    """What is known of each tunable of a tracker by name: value, also as text, unit, bounds, meaning.

    `fitted_by_default`: whether it is one of `noise_levels`.
    """
    # jax takes a second to import.
    import numpy as np

    from trackwright.trackers.core.model.tunable import meanings
    from trackwright.tuning.parameters import noise_levels

    sentences = meanings(named.tracker)
    try:
        fitted = tuple(noise_levels(named.tracker))
    except UnusableInput:
        fitted = ()
    rows = []
    for name, node in named.tunables.items():
        values = np.asarray(node.value, float)
        text = ", ".join(f"{x:.4g}" for x in values.ravel())
        if values.size > 3:
            ends = " to ".join(dict.fromkeys(f"{x:.4g}" for x in (values.min(), values.max())))
            text = f"{' x '.join(map(str, values.shape))}: {ends}"
        about = {"name": name, "value": values.tolist(), "text": text, "unit": node.unit, "bounds": node.bounds}
        rows.append(about | {"fitted_by_default": name in fitted, "meaning": sentences[name]})
    return rows
