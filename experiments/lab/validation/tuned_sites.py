"""Fits on every site as `trackwright tune` makes them, and whether their verdict is right for a recording not seen.

Every recording of a site is left out once: the fit to the others and its verdict, then the recording with its values. A
site's only recording is judged by halves.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from trackwright.experiments.cli.options import TuneOptions
from trackwright.experiments.cli.runtime import keep_programs
from trackwright.experiments.cli.tuning_folder import judged
from trackwright.experiments.cli.tuning_job import fit_folders
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, chosen, shown
from trackwright.experiments.lab.validation.sites import SITES, Site, recorded
from trackwright.experiments.pages.reports.before_after import tracked
from trackwright.experiments.pages.reports.verdict import Verdict, changed, judge
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.selection import Selection
from trackwright.tuning.calibrating import halves


def tuned_sites(*, seconds: float | None = None, site: tuple[str, ...] = (), output: Output = DEFAULTS) -> int:
    """Fits on every site without each of its recordings, their verdicts, and the recording with their values.

    Args:
        seconds: of each recording with truth, from its beginning; default: all.
        site: these sites alone.
    """
    keep_programs()
    names = chosen(site, (one.name for one in SITES))
    rows = shown(row for one in SITES if one.name in names for row in of_a_site(one, seconds))
    output.publish("validation tuned-sites", Table(rows))
    return 0


def of_a_site(site: Site, seconds: float | None) -> Iterator[Row]:
    """A row for each recording of a site that is left out."""
    folders = [shortened(folder, seconds) for folder in recorded(site.pattern)]
    folders = folders if len(folders) > 1 else list(halves(folders[0]))
    for folder in folders:
        seen = own = ""
        try:
            verdict, apart = judged_apart(site.tracker, [other for other in folders if other is not folder], folder)
            seen, own = (f"{x.word}: {x.why_not if x.change is None else changed(x.change)}" for x in (verdict, apart))
            words = verdict.word, apart.word
            right = "open" if "not" in "".join(words) else "yes" if words[0] == words[1] else "no"
        except UnusableInput as error:
            right = f"not fitted: {error}"
        yield {"site": site.name, "recording": folder.name, "of the others": seen, "on it": own, "right": right}


def shortened(folder: RecordingFolder, seconds: float | None) -> RecordingFolder:
    """The recording in the first so many seconds of its truth; all of it for None."""
    start = float(folder.tables["truth"]["t_s"][0])
    return folder if seconds is None else Selection(start=start, stop=start + seconds).of(folder)


def judged_apart(tracker: str, folders: Sequence[RecordingFolder], apart: RecordingFolder) -> tuple[Verdict, Verdict]:
    """The verdict of a fit to recordings, and that on the recording `apart` with its values."""
    with TemporaryDirectory() as place:
        options = TuneOptions(tracker=tracker, out=Path(place))
        fitted = fit_folders(list(folders), len(folders), options, lambda *_: lambda *_: None)
    compared = judged(fitted, tracked(fitted.named, folders))
    values = {name: fitted.result.values[p.label] for p in fitted.result.parameters for name in p.names}
    sides = [tracked(named, [apart]) for named in (fitted.named, fitted.named.with_values(values, "the fit"))]
    return compared.verdict, judge(sides, [apart], fitted.data.dimensions)
