"""Where recordings are, folders of folders at any depth, with digests of their content; and where results may go."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, has_control
from trackwright.trackers.recordings.folder import RecordingFolder, read_truth, refuse_repeated
from trackwright.trackers.recordings.kinds import table_kinds
from trackwright.trackers.recordings.rig_file import RIG_FILE
from trackwright.trackers.recordings.table_file import SUFFIXES

MANY = 60  # the most recordings that are tracked together: as many as a page shows
RECORDINGS, RESULTS = "recordings", "results.csv"
"""In the output folder of an archive: the folder of the finished recordings, and the table of results."""


def archive_of(paths: Sequence[Path], always: bool) -> list[Path] | None:
    """The recordings in these folders, None where they are few and none is a folder of folders, unless `always`."""
    groups = [recordings_under(path) for path in paths]
    recordings = [path for group in groups for path in group]
    if not always and len(recordings) <= MANY and groups == [[path] for path in paths]:
        return None
    refuse_repeated(recordings)
    return recordings


def recordings_under(path: Path) -> list[Path]:
    """The recordings at or below a folder, sorted, also those that cannot be read; itself where there is none."""
    recordings: list[Path] = []
    seen: set[str] = set()
    for root, folders, files in os.walk(
        path, onerror=lambda error: recordings.append(Path(error.filename)), followlinks=True
    ):
        real = os.path.realpath(root)
        if real in seen or any(map(_is_part, files)):
            folders.clear()
            if real not in seen:
                recordings.append(Path(root))
        seen.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
    return sorted(recordings) or [path]


def _is_part(name: str) -> bool:
    """Whether a file of this name is a rig.toml or a table of a recording."""
    stem, _, suffix = name.partition(".")
    return name == RIG_FILE or (stem in table_kinds() and f".{suffix}" in SUFFIXES)


def content_of(path: Path) -> str:
    """A digest of the rig.toml and the tables of a recording, and of the names beside them; raises OSError."""
    digest = hashlib.sha256()
    for entry in sorted(path.iterdir()):
        digest.update(os.fsencode(entry.name) + b"\0")
        if entry.is_file() and _is_part(entry.name):
            with entry.open("rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def read_archive(out: Path, refused: list[str]) -> list[RecordingFolder]:
    """The truths of the recordings that an archive has tracks of, by their names there; `refused` gets a line for each
    without one."""
    path, columns = out / RESULTS, dict.fromkeys(("recording", "path"), pl.String)
    try:
        rows = pl.read_csv(path, columns=[*columns], schema_overrides=columns).drop_nulls()
    except (OSError, pl.exceptions.PolarsError) as error:
        raise UnusableInput(f"{path}: cannot be read; expected the table of `track`; run `track` again") from error
    truths = list[RecordingFolder]()
    for name, source in rows.select("recording", "path").iter_rows():
        try:
            truth = replace(read_truth(Path(source)), name=name)
            if "truth" not in truth.tables:
                raise UnusableInput(f"{source}: no truth table, expected one to evaluate against")
            truths.append(truth)
        except UnusableInput as problem:
            refused.append(str(problem))
    return truths


def require_output(path: Path) -> None:
    """Raises UnusableInput for a folder that takes no results: a recording, a file, or the root of the file system."""
    why = ""
    if path.resolve() == Path(path.resolve().anchor):
        why = "is the root of the file system"
    elif has_control(str(path)):
        why = "has a control character or bytes that are no UTF-8"
    elif path.is_file():
        why = "is a file"
    elif (path / RIG_FILE).exists() and any(map(_is_part, set(os.listdir(path)) - {RIG_FILE})):
        why = "is a recording folder"
    if why:
        raise UnusableInput(f"--out {path}: {why}; expected a folder for results; choose another folder")


def require_new(out: Path, name: str, force: bool) -> None:
    """Raises UnusableInput for a file without the ending of `name`, or that exists and is not to be replaced."""
    if out.suffix != Path(name).suffix or out.is_dir():
        ending = Path(name).suffix
        raise UnusableInput(f"--out {out}: expected a file with the ending {ending}; give {name} in a folder")
    if out.exists() and not force:
        raise UnusableInput(f"--out {out}: exists; expected a new file; --force replaces it")
    require_output(out.parent)
