"""Parts of a benchmark in a process of their own, so that one that hangs or fails leaves the others their figures."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any


def new_interpreter(arguments: list[str], limit_s: float) -> subprocess.CompletedProcess[str]:
    """`python -m` with these arguments, without the user's own XLA flags; raises TimeoutExpired after `limit_s`."""
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=limit_s, check=False)


def figures_apart(module: str, option: str, part: str, limit_s: float) -> dict[str, Any]:
    """The JSON that the module prints for a part, or why there is none, under `failed`."""
    print(f"measuring: {part} …", file=sys.stderr, flush=True)
    try:
        done = new_interpreter([module, option, part], limit_s)
    except subprocess.TimeoutExpired:
        return {"failed": f"took over {limit_s:.0f} s"}
    if done.returncode:
        return {"failed": (done.stderr.strip().splitlines() or ["no message"])[-1]}
    found: dict[str, Any] = json.loads(done.stdout)
    return found
