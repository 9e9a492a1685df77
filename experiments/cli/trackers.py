"""`trackwright trackers`: what can be run, and which of its numbers can be set or fitted."""

from __future__ import annotations

import textwrap
from pathlib import Path

from trackwright.experiments.cli.commands import rows
from trackwright.experiments.cli.options import Name
from trackwright.trackers.catalogue import ENTRIES, run_files
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
        print("\n".join(rows(((name, f"{entry.about} ({entry.table})") for name, entry in ENTRIES.items()), 29)))
        return 0
    if folder is None:
        raise UnusableInput(f"trackers {tracker}: its tunables belong to an installation; give a recording FOLDER, too")
    from trackwright.experiments.text.tables import aligned, terminal_width
    from trackwright.trackers.recordings.folder import read_recording

    run_files(tracker)
    recording = read_recording(folder)
    # jax takes a second to import, which the help and a refused recording need not wait for.
    import numpy as np

    from trackwright.trackers.catalogue import build
    from trackwright.trackers.core.model.tunable import meanings
    from trackwright.tuning.parameters import noise_levels

    named = build(tracker, recording)
    sentences = meanings(named.tracker)
    try:
        fitted = {*noise_levels(named.tracker)}
    except UnusableInput:
        fitted = set[str]()
    cells = [("tunable", "value", "unit", "bounds")]
    for name, node in named.tunables.items():
        values = np.asarray(node.value, float)
        text = ", ".join(f"{x:.4g}" for x in values.ravel())
        if values.size > 3:
            ends = " to ".join(dict.fromkeys(f"{x:.4g}" for x in (values.min(), values.max())))
            text = f"{' x '.join(map(str, values.shape))}: {ends}"
        cells.append((name + "*" * (name in fitted), text, "" if node.unit == "1" else node.unit, node.bounds))
    head, *lines = aligned(cells).splitlines()
    print(head)
    meant = [sentences[name] for name in named.tunables]
    for line, sentence, following in zip(lines, meant, [*meant[1:], ""], strict=True):
        print(line.rstrip())
        if sentence and sentence != following:
            print(textwrap.fill(sentence, terminal_width(), initial_indent="    ", subsequent_indent="    "))
    return 0
