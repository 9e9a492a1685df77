"""What a recording folder holds: its rig, and the file of each table."""

from __future__ import annotations

import difflib
from pathlib import Path

from trackwright.trackers.core.errors import UnusableInput, has_control, listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.kinds import table_kinds
from trackwright.trackers.recordings.rig_file import RIG_FILE, read_rig
from trackwright.trackers.recordings.table_file import SUFFIXES

_OTHER_DATA = (
    ".txt", ".tsv", ".dat", ".json", ".xlsx", ".zip", ".bz2", ".xz", ".zst", ".feather", ".npz", ".mat", ".pq",
)  # fmt: skip


def folder_contents(path: Path) -> tuple[Rig, dict[str, Path], list[str], list[str]]:
    """The rig, the file of each table, at least one, notices, and the names of other tables.

    Raises UnusableInput for a folder or rig that cannot be read, without a table, and with two files for one.
    """
    if has_control(str(path)):
        raise UnusableInput(f"{path}: has a control character or bytes that are no UTF-8 in its name; rename it")
    try:
        entries = sorted(entry.name for entry in path.iterdir())
    except FileNotFoundError:
        raise UnusableInput(f"{path}: does not exist, expected a recording folder; check the path") from None
    except NotADirectoryError:
        raise UnusableInput(
            f"{path}: is a file, expected a recording folder with {RIG_FILE} and tables; give its folder"
        ) from None
    except OSError as error:
        raise UnusableInput(f"{path}: folder cannot be read ({error.strerror}); check its permissions") from error
    if not any(entry == RIG_FILE or entry.partition(".")[0] in table_kinds() for entry in entries):
        raise UnusableInput(
            f"{path}: neither {RIG_FILE} nor a table, expected a recording folder, or folders of these; give another"
        )
    rig, notices = read_rig(path / RIG_FILE)
    files, others = _table_files(path, entries)
    if not files:
        another = f"found {listed(others)}; another kind needs --tracker FILE.py:NAME with it (docs/extending.md)"
        found = another if others else "export one"
        raise UnusableInput(
            f"{path}: no tables, expected at least one of {', '.join(table_kinds())} as {', '.join(SUFFIXES)}; {found}"
        )
    return rig, files, [*notices], others


def _table_files(path: Path, entries: list[str]) -> tuple[dict[str, Path], list[str]]:
    """The file of each table, and the names of other tables; refuses duplicates and misspelt names."""
    files: dict[str, Path] = {}
    others = []
    for entry in entries:
        stem, _, suffix = entry.partition(".")
        if stem in table_kinds() and f".{suffix}" in SUFFIXES:
            if stem in files:
                raise UnusableInput(
                    f"{path}: both {files[stem].name} and {entry}, expected one file for table {stem}; remove one"
                )
            files[stem] = path / entry
        elif entry.lower().endswith((*SUFFIXES, *_OTHER_DATA)):
            others.append(entry)
    for entry in others:
        stem = entry.partition(".")[0].lower()
        near = difflib.get_close_matches(stem, [name for name in table_kinds() if name not in files], 1, 0.75)
        if near:
            raise UnusableInput(
                f"{path / entry}: looks like table {near[0]}, expected {' or '.join(near[0] + s for s in SUFFIXES)}; "
                "rename or convert it"
            )
    return files, [entry for entry in others if entry.lower().endswith(SUFFIXES)]
