"""`trackwright trackers`: what can be run, and which of its numbers can be set or fitted."""

from __future__ import annotations

import textwrap
from contextlib import suppress
from pathlib import Path

from trackwright.experiments.cli.options import Name
from trackwright.trackers.catalogue import ENTRIES, run_file_of
from trackwright.trackers.core.errors import UnusableInput


def trackers(tracker: Name | None = None, folder: Path | None = None, /) -> int:
    """List the trackers and the tables they read; the tunables of one.

    The first that fits the tables of a recording is chosen where none is named. A tracker of your own is a Python file:
    --tracker FILE.py:NAME.

    Tunables, with value, unit, bounds and meaning, have the names of --set, --tune, --bound and --over; those with a
    star are fitted where --tune names none.

    Args:
        tracker: one of the list, or FILE.py:NAME of a TrackerSpec of your own, whose tunables are listed.
        folder: a recording folder with the stations or anchors that it gets.
    """
    if tracker is None:
        for name, entry in ENTRIES.items():
            about = f"{name:<26} {entry.about} ({entry.table})"
            print(textwrap.fill(about, 80, subsequent_indent=" " * 27, break_on_hyphens=False))
        return 0
    if folder is None:
        raise UnusableInput(f"trackers {tracker}: its tunables belong to an installation; give a recording FOLDER, too")
    from trackwright.experiments.text.tables import aligned
    from trackwright.trackers.recordings.folder import read_recording

    run_file_of(tracker)
    recording = read_recording(folder)
    # jax takes a second to import, which the help and a refused recording need not wait for.
    import numpy as np

    from trackwright.trackers.catalogue import build
    from trackwright.trackers.core.model.tunable import meanings
    from trackwright.tuning.parameters import noise_levels

    named = build(tracker, recording)
    sentences, fitted = meanings(named.tracker), set[str]()
    with suppress(UnusableInput):
        fitted = {*noise_levels(named.tracker)}
    cells = [("tunable", "value", "unit", "bounds", "meaning")]
    for name, node in named.tunables.items():
        values = np.asarray(node.value, float)
        text = ", ".join(f"{x:.4g}" for x in values.ravel())
        if values.size > 3:
            text = f"{' x '.join(map(str, values.shape))}: {values.min():.4g} to {values.max():.4g}"
        cells.append((name + "*" * (name in fitted), text, node.unit, node.bounds, sentences[name]))
    print(aligned(cells))
    return 0
