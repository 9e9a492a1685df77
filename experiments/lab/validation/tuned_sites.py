"""Fits on every site with one recording left out each: `python -m trackwright.experiments.lab.validation.tuned_sites`.

Fits noise levels to a site's recordings as `trackwright tune` does, judges each recording with the values fitted to the
others, and names what `tune` refuses. Halves of a site's only recording are judged so. The recordings are those of
`real_recordings`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

from trackwright.experiments.cli.main import run_alone
from trackwright.experiments.cli.runtime import keep_programs, set_flags
from trackwright.experiments.cli.tuning_folder import in_words, refusals
from trackwright.experiments.lab.subprocesses import required_recordings
from trackwright.experiments.lab.validation.folds import SITES, Site
from trackwright.experiments.pages.reports.recordings_compared import Compared, compare, tracked
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.association import Association
from trackwright.trackers.recordings.folder import RecordingFolder, read_recordings
from trackwright.trackers.recordings.selection import Selection
from trackwright.tuning.cross_calibration import halves
from trackwright.tuning.fitting import FitResult, fit
from trackwright.tuning.left_out import left_out_values


def main(*, seconds: float | None = None, site: tuple[str, ...] = ()) -> None:
    """Print the table of each site, and whether `tune` writes the values.

    Args:
        seconds: of each recording with truth, from its beginning; default: all.
        site: these sites alone.
    """
    set_flags()
    keep_programs()
    root = required_recordings()
    for one in SITES:
        if site and one.name not in site:
            continue
        began = time.monotonic()
        folders = [shortened(folder, seconds) for folder in read_recordings([root / name for name in one.recordings])]
        try:
            result, compared = judged(one, folders if len(folders) > 1 else list(halves(folders[0])))
        except UnusableInput as error:
            print(f"{one.name}: not fitted: {error}", flush=True)
            continue
        refused = refusals(result, compared, held_out=False)
        print(f"{one.name}, {one.tracker} ({time.monotonic() - began:.0f} s)\n{compared.text()}", end="")
        print(f"refused: {in_words(refused)}\n" if refused else "written\n", flush=True)


def shortened(folder: RecordingFolder, seconds: float | None) -> RecordingFolder:
    """The recording in the first so many seconds of its truth; all of it for None."""
    start = float(folder.tables["truth"]["t_s"][0])
    return folder if seconds is None else Selection(start=start, stop=start + seconds).of(folder)


def judged(site: Site, folders: Sequence[RecordingFolder]) -> tuple[FitResult, Compared]:
    """The fit to all recordings, and each of them with the defaults and with the values fitted to the others."""
    named = build(site.tracker, folders)
    result = fit(named, folders)
    left_out = left_out_values(result)
    after = []
    for folder in folders:
        values = left_out.get(folder.name, result.values)
        own = {name: values[p.label] for p in result.parameters for name in p.names}
        after.append(tracked(named.with_values(own, "the fit"), [folder]))
    dimensions = getattr(result.problem.objective, "dimensions", 2)
    about = f"{site.name}, each with values fitted to the others"
    return result, compare((tracked(named, folders), Association.joined(after)), folders, dimensions, about)


if __name__ == "__main__":
    run_alone(main, "python -m trackwright.experiments.lab.validation.tuned_sites")
