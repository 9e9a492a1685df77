"""`trackwright survey`."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Annotated

from cyclopts import Parameter

from trackwright.experiments.cli.options import File, Recording, require_new

Names = Annotated[str, Parameter(metavar="A1,A2,…")]


def survey(
    *recordings: Recording, out: File, given: Names | None = None, sigma: float = 0.0, frame: Names | None = None,
    height: float | None = None, force: bool = False, json: bool = False,
) -> int:  # fmt: skip
    """Survey anchors: their positions and delays, from walks with ranges, without truth.

    Writes a rig.toml that `track` takes, and beside it a page. Anchors that rig.toml of the walks lacks are found, too.

    Args:
        recordings: recording folders with ranges to the same anchors; truth, if there is any, is not used.
        out: the file to write, as rig.toml; the page goes beside it.
        given: anchors whose positions in rig.toml are known, or all.
        sigma: their standard deviation, m, as 0.05 by tape; default: exact.
        frame: without given anchors: origin, x axis, and one to the left of it; default: the first.
        height: of the tags, m; default: as in rig.toml, else estimated.
        force: replace a file that exists, and take ranges in spite of the errors that `trackwright check` finds.
        json: print positions, delays, intervals and verdicts as JSON instead of a table.
    """
    require_new(out, "rig.toml", force)
    from trackwright.experiments.cli.console import checked, json_alone, output_folder
    from trackwright.experiments.text.terminal import notice, stages
    from trackwright.trackers.recordings.folder import read_recording, refuse_repeated

    refuse_repeated(recordings)
    folders = [read_recording(path, placed=False) for path in recordings]
    # No other table is used, and positions in rig.toml may be wrong.
    alone = [replace(x, tables={"ranges": x.tables["ranges"]}) for x in folders if "ranges" in x.tables]
    checked([replace(x, rig=replace(x.rig, anchors={})) for x in alone], force, True)
    # scipy and matplotlib take a second to import, which the help and a refused recording need not wait for.
    from trackwright.experiments.pages.reports.survey import survey_data, write_survey_page
    from trackwright.trackers.recordings.atomic import atomic_write
    from trackwright.trackers.recordings.rig_file import rig_text
    from trackwright.tuning.survey.surveying import survey as survey_walks

    with stages("survey") as begin:
        begin("fitting positions and paths")
        result = survey_walks(folders, given or (), sigma, frame or (), height)
    output_folder(out.parent)
    for line in result.notes:
        notice(f"notice: {line}")
    atomic_write(out, lambda path: path.write_text(rig_text(result.rig), encoding="utf-8"))
    page = write_survey_page(out, result, sys.argv)
    with json_alone(json) as put:
        print(f"{result}\nwrote {out} and {page.name}")
        put(survey_data(result))
    return 0
