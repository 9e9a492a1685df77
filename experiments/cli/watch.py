"""`trackwright watch`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from trackwright.experiments.cli.options import File, Recording, require_output
from trackwright.trackers.core.errors import UnusableInput

if TYPE_CHECKING:
    from trackwright.trackers.recordings.folder import RecordingFolder


def watch(
    *runs: Recording,
    baseline: tuple[Annotated[Recording, Parameter(metavar="RUN")], ...],
    smallest: float = 1.0,
    alarms: float = 1.0,
    out: File | None = None,
    force: bool = False,
    json: bool = False,
) -> int:
    """Tell when a site has changed: what, when, how much, and what to do.

    A sequential test of each anchor, station and place on ranges, range differences and bearings; truth, if there is
    any, is not used. The exit code is 1 if there is a change.

    Args:
        runs: recording folders to watch, in the order of time.
        baseline: recording folders of the same site in normal operation, ten minutes at least for changes of 10 cm.
        smallest: the smallest changes that count, in units of 10 cm and 3°.
        alarms: false alarms a day, at most, of all anchors, stations and places together.
        out: a figure to write, as watch.png: the statistics over time with their threshold.
        force: replace a figure that exists, and take recordings in spite of the errors that `trackwright check` finds.
        json: print the verdict as JSON instead of lines.
    """
    if out is not None and (out.suffix not in (".png", ".pdf") or out.is_dir()):
        raise UnusableInput(f"--out {out}: expected a file with the ending .png or .pdf; give watch.png in a folder")
    if out is not None and out.exists() and not force:
        raise UnusableInput(f"--out {out}: exists; expected a new file; --force replaces it")
    if out is not None:
        require_output(out.parent)
    from trackwright.experiments.cli.console import checked, json_alone, output_folder
    from trackwright.experiments.cli.runtime import keep_programs
    from trackwright.trackers.recordings.folder import read_recordings

    folders = checked(untrue(read_recordings([*runs, *baseline])), force, calibrated=True)
    keep_programs()
    # jax and scipy take a second to import, which the help and a refused recording need not wait for.
    from trackwright.experiments.pages.reports.watch import watch_data, write_watch_figure
    from trackwright.tuning.watch.watching import watch as watch_runs

    found = watch_runs(folders[: len(runs)], folders[len(runs) :], smallest, alarms)
    with json_alone(json) as put:
        print(found)
        if out is not None:
            output_folder(out.parent)
            print(f"wrote {write_watch_figure(out, found)}")
        put(watch_data(found))
    return int(found.changed)


def untrue(recordings: Iterable[RecordingFolder]) -> list[RecordingFolder]:
    """Recordings without truth: one that disagrees with the readings is what a change looks like, and no mistake."""
    return [replace(x, tables={k: t for k, t in x.tables.items() if k != "truth"}) for x in recordings]
