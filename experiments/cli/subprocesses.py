"""`trackwright` commands run one after another, as a person would type them: for the demo and the printed tables."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).parents[1]


def real_recordings() -> Path | None:
    """The folder of real recordings: TRACKWRIGHT_RECORDINGS, else `../shared/recordings` beside the repository."""
    folder = Path(os.environ.get("TRACKWRIGHT_RECORDINGS", REPOSITORY.parent / "shared" / "recordings"))
    return folder if folder.is_dir() else None


def command(*arguments: str | Path) -> None:
    """Print the command and run it, its output to the terminal; exits with its code where it fails."""
    print(f"\n$ trackwright {shlex.join(map(str, arguments))}", flush=True)
    _checked(subprocess.run(_line(arguments), check=False))


def figures(tracks: Path) -> dict[str, Any]:
    """What `trackwright evaluate TRACKS --json` prints."""
    done = subprocess.run(_line(("evaluate", tracks, "--json")), check=False, stdout=subprocess.PIPE, text=True)
    _checked(done)
    return json.loads(done.stdout)


def _line(arguments: Sequence[str | Path]) -> list[str]:
    return [sys.executable, "-m", "experiments", *map(str, arguments)]


def _checked(done: subprocess.CompletedProcess) -> None:
    if done.returncode:
        sys.exit(done.returncode)
