"""The evidence of `trackwright track --protection`: folders of `track` of other recordings of the site, with truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import polars as pl

from trackwright.experiments.cli.evaluating import sources
from trackwright.experiments.cli.options import TrackOptions
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.protection import Protection, protection
from trackwright.trackers.recordings.atomic import json_text
from trackwright.trackers.recordings.calibration import read_calibration
from trackwright.trackers.recordings.folder import read_recordings
from trackwright.trackers.recordings.input_file import file_bytes
from trackwright.trackers.recordings.tracks_table import read_tracks

FREE = ("seed", "part", "protection", "probability")
"""Options of `track` that evidence need not share."""

FILES = ("noise", "calibration")
"""Options with a file, of which evidence has one of its own where the run has one."""


def protection_of(options: TrackOptions, tracker: str) -> Protection:
    """The protection level from `--protection`, for a run of this tracker.

    Raises UnusableInput as `protection`, for evidence that was tracked otherwise, and for a recording of the evidence
    on which the calibration that tracked it was estimated.
    """
    expected = json.loads(json_text(options.manifest(tracker)))
    parts, folders = [], []
    for path in options.protection:
        parts.append(read_tracks(path))
        recordings = read_recordings(sources(path))  # `track` printed their notices when they were tracked
        _refuse_others(path, expected, {folder.name for folder in recordings})
        folders += recordings
    tracks = pl.concat(parts, how="diagonal_relaxed")
    return protection(tracks, folders, options.probability)


def _refuse_others(path: Path, expected: dict[str, Any], tracked: set[str]) -> None:
    """Raises UnusableInput for evidence whose tracker, levels or options differ, or whose calibration has seen it."""
    manifest = path / "manifest.json"
    try:
        config = json.loads(file_bytes(manifest))["config"]
        found = {name: config[name] for name in expected if name not in FREE}
    except (OSError, ValueError, KeyError, TypeError):
        raise UnusableInput(
            f"--protection {path}: no usable manifest.json; expected the output folder of `trackwright track`"
        ) from None
    for name, value in found.items():
        mine = expected[name]
        if (bool(value) != bool(mine)) if name in FILES else (value != mine):
            raise UnusableInput(
                f"--protection {path}: was tracked with {name} {value!r}, this run has {mine!r}; track both alike"
            )
    file = Path(found["calibration"]) if found["calibration"] else None
    if file is not None and file.is_file():
        seen = sorted(tracked & set(read_calibration(file).recordings))
        if seen:
            raise UnusableInput(
                f"--protection {path}: {file} was estimated on {seen[0]}, which it tracked; expected a calibration on "
                "other recordings"
            )
