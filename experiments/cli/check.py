"""`trackwright check`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from experiments.cli.console import require_some
from trackers.recordings.checks.check import check_folder
from trackers.recordings.checks.findings import format_findings
from trackers.recordings.folder import read_recording


def check(recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]) -> int:
    """Say what is wrong or odd in recordings: time base, order, gaps, units, ids, rates, geometry. Exit 1 on an error.

    Args:
        recordings: recording folders (rig.toml and tables).
    """
    require_some(recordings)
    failed = False
    for path in recordings:
        findings = check_folder(read_recording(path))
        failed |= any(f.level == "error" for f in findings)
        print(f"{path}\n{format_findings(findings)}")
    return int(failed)
