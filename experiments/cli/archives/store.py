"""What an archive's output keeps of each finished recording: a folder each, the last file of which says what of."""

from __future__ import annotations

import hashlib
import json
import os
import re
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from trackwright.experiments.cli.archives.folders import RECORDINGS, is_table
from trackwright.experiments.cli.archives.part import Found
from trackwright.experiments.text.evaluation_text import to_json
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.atomic import atomic_write, json_text
from trackwright.trackers.recordings.input_file import file_bytes
from trackwright.trackers.recordings.rig_file import RIG_FILE
from trackwright.trackers.recordings.tracks_table import EVALUATION, SOURCES, write_tracks

TRACKED, SCORED = "tracked.json", "scored.json"
"""The files that `track` and `evaluate` write last into the folder of a finished recording."""


class Item(NamedTuple):
    """A recording of an archive: its path, its folder in the output, and what its outcome depends on, if known."""

    path: Path
    folder: Path
    fingerprint: str | None


class RecordingStore(NamedTuple):
    """The finished recordings in the output folder of an archive; `name`: of the file that is written last."""

    out: Path
    name: str

    def folder(self, path: Path) -> Path:
        """The folder of the recording at `path`: its name, and a digest of the path."""
        whole = path.resolve()
        digest = hashlib.sha256(os.fsencode(whole)).hexdigest()[:8]
        plain = re.sub(r"[^\w.-]", "_", whole.name, flags=re.ASCII)[:80]
        return self.out / RECORDINGS / f"{plain}-{digest}"

    def read(self, folder: Path, fingerprint: str | None) -> dict[str, Any] | None:
        """What is kept of a finished recording; None where it is not finished, of other content, or damaged."""
        try:
            kept = self.kept(folder)
            if fingerprint is None or kept["fingerprint"] != fingerprint:
                return None
            whole = all((folder / name).stat().st_size == size for name, size in kept["bytes"].items())
        except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
            return None
        return kept if whole else None

    def kept(self, folder: Path) -> dict[str, Any]:
        """What is kept of a finished recording."""
        found: dict[str, Any] = json.loads(file_bytes(folder / self.name))
        return found

    def write(self, item: Item, found: Found) -> None:
        """Keeps what was found; the file that says so is written last. Raises UnusableInput where the disk is full."""
        sizes = {}
        try:
            for outcome in found.outcomes:
                (item.folder / outcome.summary["short"]).mkdir(parents=True, exist_ok=True)
            # What it says is no longer true of the tables that are replaced.
            (item.folder / self.name).unlink(missing_ok=True)
        except OSError as error:
            raise UnusableInput(f"{item.folder}: cannot be written ({error.strerror}); choose another --out") from error
        for outcome in found.outcomes:
            short = outcome.summary["short"]
            own = item.folder / short
            for name, table in outcome.tables.items():
                sizes[f"{short}/{name}"] = atomic_write(own / name, partial(write_tracks, table)).stat().st_size
            _write_text(own / SOURCES, f"{item.path.resolve()}\n")
            _write_text(own / EVALUATION, to_json(outcome.evaluation))
        kept = {
            "fingerprint": item.fingerprint,
            "outcomes": [outcome.summary for outcome in found.outcomes],
            "refused": found.refused,
            "notices": found.notices,
            "bytes": sizes,
        }
        _write_text(item.folder / self.name, json_text(kept))


def _write_text(path: Path, text: str) -> None:
    atomic_write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def content_of(path: Path) -> str:
    """A digest of the rig.toml and the tables of a recording, and of the names beside them; raises OSError."""
    digest = hashlib.sha256()
    for entry in sorted(path.iterdir()):
        digest.update(os.fsencode(entry.name) + b"\0")
        if entry.is_file() and (entry.name == RIG_FILE or is_table(entry.name)):
            digest.update(digest_of(entry))
    return digest.hexdigest()


def digest_of(path: Path) -> bytes:
    """The SHA-256 of a file; raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").digest()
