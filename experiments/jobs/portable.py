"""Users' files as text that travels to other processes, and the trackers in them."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.user_file import split_name
from trackwright.trackers.recordings.tracker_spec import TrackerSpec

Files = tuple[tuple[str, str], ...]  # users' files: the path of each, as it was given, and its text


@contextmanager
def copied(files: Files) -> Iterator[dict[str, str]]:
    """The files in a temporary folder: the place of each by its path."""
    places = {}
    with tempfile.TemporaryDirectory(prefix="trackwright-") as folder:
        for k, (path, text) in enumerate(files):
            copy = Path(folder) / f"{k}" / Path(path).name
            copy.parent.mkdir()
            copy.write_text(text, "utf-8")
            places[path] = str(copy)
        yield places


def file_of(name: str) -> str:
    """The text of the user's file of a tracker given as `FILE.py:NAME`; empty for one of the catalogue."""
    file, _ = split_name(name)
    return Path(file).read_text("utf-8") if file else ""


@functools.lru_cache(maxsize=8)
def spec_here(name: str, text: str) -> TrackerSpec:
    """The entry of the catalogue, or of a user's file with this text; kept, since its programs are compiled."""
    file, attribute = split_name(name)
    if not file:
        return spec_of(name)
    with copied(((file, text),)) as places:
        return spec_of(f"{places[file]}:{attribute}")
