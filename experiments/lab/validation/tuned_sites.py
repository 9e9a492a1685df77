"""Fits on every site as `trackwright tune` makes them, and what it refuses.

Each recording is judged with the values fitted to the others; halves of a site's only recording are judged so.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

from trackwright.experiments.cli.runtime import keep_programs
from trackwright.experiments.cli.tuning_folder import in_words, refusals
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, chosen, shown
from trackwright.experiments.lab.validation.sites import SITES, Site, recorded
from trackwright.experiments.pages.reports.before_after import Compared, compare, tracked
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.association import Association
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.selection import Selection
from trackwright.tuning.calibrating import halves
from trackwright.tuning.fitting import FitResult, fit
from trackwright.tuning.intervals import left_out_values


def tuned_sites(*, seconds: float | None = None, site: tuple[str, ...] = (), output: Output = DEFAULTS) -> int:
    """Fits on every site with one recording left out each, and whether `tune` writes the values.

    Args:
        seconds: of each recording with truth, from its beginning; default: all.
        site: these sites alone.
    """
    keep_programs()
    names = chosen(site, (one.name for one in SITES))
    rows = shown(of_a_site(one, seconds) for one in SITES if one.name in names)
    output.publish("validation tuned-sites", Table(rows))
    return 0


def of_a_site(site: Site, seconds: float | None) -> Row:
    """What a fit to a site's recordings ends with; its table is printed."""
    began = time.monotonic()
    folders = [shortened(folder, seconds) for folder in recorded(site.pattern)]
    try:
        result, compared = judged(site, folders if len(folders) > 1 else list(halves(folders[0])))
    except UnusableInput as error:
        ended = f"not fitted: {error}"
    else:
        print(f"{site.name}\n{compared.text()}", end="", flush=True)
        refused = refusals(result, compared, held_out=False)
        ended = f"refused: {in_words(refused)}" if refused else "written"
    return {"site": site.name, "tracker": site.tracker, "s": time.monotonic() - began, "tune": ended}


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
        by_name = {name: values[p.label] for p in result.parameters for name in p.names}
        after.append(tracked(named.with_values(by_name, "the fit"), [folder]))
    dimensions = getattr(result.problem.objective, "dimensions", 2)
    about = f"{site.name}, each with values fitted to the others"
    return result, compare((tracked(named, folders), Association.joined(after)), folders, dimensions, about)
