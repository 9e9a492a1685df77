"""The formats of files that `import` reads, in one table, and those that a user's file brings.

Light, as help lists the formats: what reads a file is imported when one is read.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from trackwright.trackers.core.errors import UnusableInput, listed, near
from trackwright.trackers.core.user_file import split_name


class Format(NamedTuple):
    """A format: `words` for its files, and the module beside this one whose `read_source` reads them.

    `read_source(path, name, asked)` gives a `Source`, or raises UnusableInput with file and line; `name` is that of the
    format. `endings` of names, `folder`, a file that a folder of the format has, and `begins`, a pattern in the first
    lines, tell its files from others. `has_tables`: whether the files say themselves which tables they hold.
    """

    words: str
    module: str
    endings: tuple[str, ...] = ()
    folder: str = ""
    begins: re.Pattern[str] | None = None
    has_tables: bool = False


def _first_line(pattern: str) -> re.Pattern[str]:
    """The pattern of a whole line, the first that is neither empty nor a comment."""
    return re.compile(rf"\A(?:\s*(?:#.*)?\n)*[ \t]*{pattern}[ \t\r]*$", re.MULTILINE)


FORMATS: Mapping[str, Format] = {
    "csv": Format("a table (.csv, .csv.gz, .tsv, .parquet; other text by --format csv)", "mapping",
        (".csv", ".csv.gz", ".tsv", ".parquet")),
    "ros": Format(
        "a ROS bag (.bag, .db3, .mcap, or the folder of a ROS 2 bag)", "ros_reader", (".bag", ".mcap", ".db3"),
        folder="metadata.yaml",
    ),
    "dwm1001": Format(
        "a log of a DWM1001 kit", "serial_logs",
        begins=re.compile(r"DIST,|POS,|[0-9A-Fa-f]{4}\[-?\d+(?:\.\d+)?,"), has_tables=True,
    ),
    "trek1000": Format(
        "a log of a TREK1000 kit", "serial_logs", begins=re.compile(r"m[acr] [0-9a-fA-F]{2} "), has_tables=True,
    ),
    "fira": Format(
        "a log of a kit with FiRa, as DWM3001CDK", "serial_logs",
        begins=re.compile(r'\{"Block":\s*\d+'), has_tables=True,
    ),
    "tum": Format(
        "a TUM trajectory", "trajectories", (".tum",), begins=_first_line(r"[^,\s]+(?:[ \t]+[^,\s]+){7}")
    ),
    "kitti": Format(
        "a KITTI trajectory", "trajectories", (".kitti",), begins=_first_line(r"[^,\s]+(?:[ \t]+[^,\s]+){11}")
    ),
    # EuRoC counts whole nanoseconds.
    "euroc": Format(
        "a EuRoC trajectory", "trajectories", (".euroc",),
        begins=_first_line(r"-?\d+[ \t]*(?:,[ \t]*[^,\s][^,\n]*){7,},?"),
    ),
    "json": Format(
        "JSON lines (.jsonl, .ndjson, .json)", "mapping", (".jsonl", ".ndjson", ".json"),
        begins=re.compile(r"^[^{\n]*\{.*\}\s*$", re.MULTILINE),
    ),
}  # fmt: skip
"""The formats by their names."""


def format_of(path: Path) -> str:
    """The name of a file's format, by that of the file or else by its first lines.

    Raises UnusableInput where it is not clear, and for a file that cannot be read.
    """
    if path.is_dir():
        for name, entry in FORMATS.items():
            if entry.folder and (path / entry.folder).is_file():
                return name
        raise UnusableInput(f"{path}: is a folder without metadata.yaml; expected a ROS 2 bag, or a file")
    ending = path.name.lower()
    named = next((name for name, entry in FORMATS.items() if ending.endswith(entry.endings)), None)
    # EuRoC's own files are called data.csv.
    begin = beginning_of(path) if named in (None, "csv", "json") else ""
    fira = FORMATS["fira"].begins
    if named == "json" and fira is not None and fira.search(begin):
        return "fira"
    if named is not None and not (named == "csv" and begin.startswith("#timestamp")):
        return named
    for name, entry in FORMATS.items():
        if entry.begins is not None and entry.begins.search(begin):
            return name
    words = listed((entry.words for entry in FORMATS.values()), len(FORMATS))
    raise UnusableInput(f"{path}: no format is recognised; expected {words}; --format names one, or your own")


def beginning_of(path: Path) -> str:
    """The first lines of a file; raises UnusableInput for one that cannot be read."""
    from trackwright.trackers.recordings.input_file import beginning

    try:
        return beginning(path, 20_000).decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise UnusableInput(f"{path}: cannot be read ({error.strerror}); check the path") from error


def has_tables(name: str) -> bool:
    """Whether the files of a format, by its name or a user's own by `FILE.py:NAME`, say which tables they hold.

    Raises UnusableInput for another name.
    """
    if name in FORMATS:
        return FORMATS[name].has_tables
    if split_name(name)[0]:
        return True
    raise UnusableInput(f"--format {name}: expected {', '.join(FORMATS)} or FILE.py:NAME{near(name, FORMATS)}")
