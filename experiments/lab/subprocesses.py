"""Fresh processes: `trackwright` as a user types it, and a Python that may hang or fail."""

import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from trackwright.trackers.core.errors import UnusableInput

REPOSITORY = Path(__file__).resolve().parents[2]
"""The checkout: the folder `trackwright` in it holds links."""


def recordings_folder() -> Path | None:
    """The folder of real recordings: TRACKWRIGHT_RECORDINGS, else `../shared/recordings` beside the repository."""
    folder = Path(os.environ.get("TRACKWRIGHT_RECORDINGS", REPOSITORY.parent / "shared" / "recordings"))
    return folder if folder.is_dir() else None


def required_recordings() -> Path:
    """The folder of real recordings; raises UnusableInput where there is none."""
    folder = recordings_folder()
    if folder is None:
        raise UnusableInput(
            "no folder of real recordings; expected ../shared/recordings or a folder named by TRACKWRIGHT_RECORDINGS"
        )
    return folder


def command(*arguments: str | Path, folder: Path | None = None) -> None:
    """Print a `trackwright` command and run it, its output to the terminal; exits with its code if it fails.

    `folder`: the one it runs in; the current one by default.
    """
    print(f"\n$ trackwright {shlex.join(map(str, arguments))}", flush=True)
    line = [sys.executable, "-m", "trackwright", *map(str, arguments)]
    if code := subprocess.run(line, check=False, cwd=folder).returncode:
        sys.exit(code)


def new_interpreter(arguments: Sequence[str], limit_s: float) -> None:
    """Run Python with these arguments, without the user's XLA flags.

    Raises RuntimeError with the last line of its errors if it fails, and TimeoutExpired after `limit_s`.
    """
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    line = [sys.executable, *arguments]
    done = subprocess.run(line, env=environment, capture_output=True, text=True, timeout=limit_s, check=False)
    if done.returncode:
        raise RuntimeError((done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1])
