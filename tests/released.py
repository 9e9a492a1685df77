"""Numbers that keep their bits from release to release: `python -m tests.released`; exit code 1 where one has moved.

`released.json` has a SHA-256 of each subject's arrays (`tests/digests.py`) and, after a change that was meant, a second
one behind it, whose first twelve digits stand in a line of CHANGELOG.md that says why. Bits depend on the processor,
jaxlib and NumPy: elsewhere exit code 2, and `make digests DIGESTS=REV` compares two commits on one machine. `--write`
adds what has moved.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from tests.digests import KEPT as COMPUTED
from tests.digests import subject
from tests.json_lines import write_json
from trackwright.trackers.core.programs import processor

KEPT = Path(__file__).with_suffix(".json")
CHANGES = Path(__file__).parents[1] / "CHANGELOG.md"
SHOWN = 12  # digits of a digest in the changelog


def main() -> int:
    """Compare or add; exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true", help="add the digests that have moved")
    write = parser.parse_args().write
    kept = json.loads(KEPT.read_text("utf-8"))
    if not write and kept["environment"] != environment():
        print(f"kept for {kept['environment']}, here {environment()}; compare commits with `make digests DIGESTS=REV`")
        return 2
    os.environ.setdefault("TRACKWRIGHT_CACHE", str(COMPUTED.parent / "digest-programs"))
    found = {name: digest(subject(*name.split(", ", 1))) for name in kept["digests"]}
    moved = {name: text for name, text in found.items() if kept["digests"][name][-1:] != [text]}
    for name, text in moved.items():
        print(f"{name}: {text[:SHOWN]}, kept {kept['digests'][name][-1:] or 'none'}")
    if write:
        digests = {name: texts + [found[name]] * (name in moved) for name, texts in kept["digests"].items()}
        write_json(KEPT, {"environment": environment(), "digests": digests})
        return 0
    print(f"{len(found) - len(moved)} of {len(found)} subjects have the bits of the release")
    return bool(moved)


def environment() -> dict[str, str]:
    """What bits depend on, besides the code."""
    return {"processor": processor(), **{name: version(name) for name in ("jaxlib", "numpy")}}


def digest(arrays: Mapping[str, np.ndarray]) -> str:
    """The SHA-256 of arrays, with their names, types and shapes."""
    total = hashlib.sha256()
    for name, values in sorted(arrays.items()):
        total.update(f"{name} {values.dtype} {values.shape} ".encode())
        total.update(np.ascontiguousarray(values).tobytes())
    return total.hexdigest()


def unexplained(kept: dict[str, Any], changes: str) -> list[str]:
    """The digests that replaced one of a release and that no line of the changelog names."""
    return [
        f"{name}: {text[:SHOWN]}"
        for name, texts in kept["digests"].items()
        for text in texts[1:]
        if text[:SHOWN] not in changes
    ]


if __name__ == "__main__":
    sys.exit(main())
