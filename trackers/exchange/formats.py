"""The formats of files that `import` reads, in one table, and those that a user's file brings.

Light, as help lists the formats: what reads a file is imported when one is read.
"""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from trackwright.trackers.core.errors import UnusableInput, listed, near
from trackwright.trackers.core.user_file import split_name


class Format(NamedTuple):
    """A format: `words` for its files, and the module beside this one whose `read_source` reads them.

    `read_source(path, name, asked)` gives a `Source`, or raises UnusableInput with file and line; `name`: of
    the format. `endings` of names and `begins`, a pattern in the first lines, tell its files from others. `has_tables`:
    whether the files say themselves which tables they hold.
    """

    words: str
    module: str
    endings: tuple[str, ...] = ()
    begins: str = r"(?!)"
    has_tables: bool = False


def _first_line(pattern: str) -> str:
    """The pattern of a whole line, the first that is neither empty nor a comment."""
    return rf"\A(?:\s*(?:#.*)?\n)*[ \t]*{pattern}[ \t\r]*$"


FORMATS: dict[str, Format] = {
    "csv": Format("a table (.csv, .csv.gz, .tsv, .parquet, or text with columns)", "mapping",
        (".csv", ".csv.gz", ".tsv", ".parquet")),
    "ros": Format("a ROS bag (.bag, .db3, .mcap, or the folder of a ROS 2 bag)", "ros_reader",
        (".bag", ".mcap", ".db3")),
    "dwm1001": Format("a log of a DWM1001 kit", "serial_logs", (),
        r"DIST,|POS,|[0-9A-Fa-f]{4}\[-?\d+(?:\.\d+)?,", has_tables=True),
    "trek1000": Format("a log of a TREK1000 kit", "serial_logs", (), r"m[acr] [0-9a-fA-F]{2} ", has_tables=True),
    "fira": Format("a log of a kit with FiRa, as DWM3001CDK", "serial_logs", (), r'\{"Block":\s*\d+', has_tables=True),
    "tum": Format("a TUM trajectory", "trajectories", (".tum",), _first_line(r"[^,\s]+(?:[ \t]+[^,\s]+){7}")),
    "kitti": Format("a KITTI trajectory", "trajectories", (".kitti",), _first_line(r"[^,\s]+(?:[ \t]+[^,\s]+){11}")),
    # EuRoC counts whole nanoseconds.
    "euroc": Format("a EuRoC trajectory", "trajectories", (".euroc",),
        _first_line(r"-?\d+[ \t]*(?:,[ \t]*[^,\s][^,\n]*){7,},?")),
    "json": Format("JSON lines (.jsonl, .ndjson, .json)", "mapping", (".jsonl", ".ndjson", ".json"),
        r"^[^{\n]*\{.*\}\s*$"),
}  # fmt: skip
"""The formats by their names."""


def format_of(path: Path) -> str:
    """The name of a file's format, by its own name or else by its first lines.

    Raises UnusableInput where it is not clear, and for a file that cannot be read.
    """
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return "ros"
        raise UnusableInput(f"{path}: is a folder without metadata.yaml; expected a ROS 2 bag, or a file")
    ending = path.name.lower()
    named = next((name for name, entry in FORMATS.items() if ending.endswith(entry.endings)), None)
    begin = beginning_of(path) if named in (None, "csv", "json") else ""
    # EuRoC's own files are called data.csv, and results of FiRa are JSON.
    if named and not (begin.startswith("#timestamp") or re.search(FORMATS["fira"].begins, begin)):
        return named
    for name, entry in FORMATS.items():
        if re.search(entry.begins, begin, re.MULTILINE):
            return name
    if _has_columns(begin):
        return "csv"
    words = listed((entry.words for entry in FORMATS.values()), len(FORMATS))
    raise UnusableInput(f"{path}: no format is recognised; expected {words}; --format names one, or your own")


def _has_columns(begin: str) -> bool:
    """Whether two lines after each other, but for comments, have cells of which half or more are numbers.

    Where blanks separate them, as words of a log, all but the first are.
    """
    number = re.compile(r"\s*[-+]?[\d.,]*\d[\d.,]*(?:[eE][-+]?\d+)?\s*")
    lines = [line for line in begin.split("\n")[:60] if line.strip() and not line.startswith(("#", "%", "//"))]
    for mark in ("\t", ";", ",", None):
        rows = [[bool(number.fullmatch(cell)) for cell in line.split(mark)] for line in lines]
        fits = [len(row) > 1 and (2 * sum(row) >= len(row) if mark else all(row[1:])) for row in rows]
        if any(a and b for a, b in pairwise(fits)):
            return True
    return False


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
