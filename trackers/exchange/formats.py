"""The formats of files that `import` reads, in one table: what reads a file is imported when one is read."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from trackwright.trackers.core.errors import UnusableInput, listed, near
from trackwright.trackers.core.user_file import split_name


class Format(NamedTuple):
    """`words` for files that `endings` and `begins`, a pattern in the first lines, tell, and the module of a reader."""

    words: str
    module: str
    endings: tuple[str, ...] = ()
    begins: str = r"(?!)"


_FIRST = r"\A(?:\s*(?:#.*)?\n)*[ \t]*{}[ \t\r]*$"  # the first line that is neither empty nor a comment

FORMATS: dict[str, Format] = {
    "csv": Format("a table (.csv, .csv.gz, .tsv, .parquet, or text with columns)", "mapping",
        (".csv", ".csv.gz", ".tsv", ".parquet")),
    "ros": Format("a ROS bag (.bag, .db3, .mcap, or the folder of a ROS 2 bag)", "ros_reader",
        (".bag", ".mcap", ".db3")),
    "dwm1001": Format("a log of a DWM1001 kit", "kit_logs", (),
        r"DIST,|POS,|[0-9A-Fa-f]{4}\[-?\d+(?:\.\d+)?,"),
    "trek1000": Format("a log of a TREK1000 kit", "kit_logs", (), r"m[acr] [0-9a-fA-F]{2} "),
    "fira": Format("a log of a kit with FiRa, as DWM3001CDK", "kit_logs", (), r'\{"Block":\s*\d+'),
    "tum": Format("a TUM trajectory", "trajectories", (".tum",), _FIRST.format(r"[^,\s]+(?:[ \t]+[^,\s]+){7}")),
    "kitti": Format("a KITTI trajectory", "trajectories", (".kitti",), _FIRST.format(r"[^,\s]+(?:[ \t]+[^,\s]+){11}")),
    # EuRoC counts whole nanoseconds.
    "euroc": Format("a EuRoC trajectory", "trajectories", (".euroc",),
        _FIRST.format(r"-?\d+[ \t]*(?:,[ \t]*[^,\s][^,\n]*){7,},?")),
    "json": Format("JSON lines (.jsonl, .ndjson, .json)", "mapping", (".jsonl", ".ndjson", ".json"),
        r"^[^{\n]*\{.*\}\s*$"),
}  # fmt: skip
"""The formats by their names."""


def format_of(path: Path) -> str:
    """The name of a file's format, by its own name or else its first lines; raises UnusableInput where none fits."""
    if (path / "metadata.yaml").is_file():
        return "ros"
    if path.is_dir():
        raise UnusableInput(f"{path}: is a folder without metadata.yaml; expected a ROS 2 bag, or a file")
    named = next((name for name, entry in FORMATS.items() if path.name.lower().endswith(entry.endings)), None)
    begin = beginning_of(path) if named in (None, "csv", "json") else ""
    # EuRoC's own files are called data.csv, and results of FiRa are JSON.
    if named and not (begin.startswith("#timestamp") or re.search(FORMATS["fira"].begins, begin)):
        return named
    for name, entry in FORMATS.items():
        if re.search(entry.begins, begin, re.MULTILINE):
            return name
    # Two lines after each other have columns of numbers, all but the first where blanks separate them.
    lines = [line for line in begin.split("\n")[:60] if line.strip() and not line.startswith(("#", "%", "//"))]
    for mark in ("\t", ";", ",", None):
        rows = [[bool(re.fullmatch(r"\s*[-+\d.,eE]*\d[-+\d.,eE]*\s*", c)) for c in line.split(mark)] for line in lines]
        fits = [len(row) > 1 and (2 * sum(row) >= len(row) if mark else all(row[1:])) for row in rows]
        if any(a and b for a, b in pairwise(fits)):
            return "csv"
    words = listed((entry.words for entry in FORMATS.values()), len(FORMATS))
    raise UnusableInput(f"{path}: no format is recognised; expected {words}; --format names one, or your own")


def beginning_of(path: Path) -> str:
    """The first lines of a file; raises UnusableInput for one that cannot be read."""
    from trackwright.trackers.recordings.input_file import file_bytes

    try:
        return file_bytes(path, 20_000).decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise UnusableInput(f"{path}: cannot be read ({error.strerror}); check the path") from error


def has_tables(name: str) -> bool:
    """Whether files of a format, or of a user's own by `FILE.py:NAME`, say which tables they hold; or UnusableInput."""
    if name not in FORMATS and not split_name(name)[0]:
        raise UnusableInput(f"--format {name}: expected {', '.join(FORMATS)} or FILE.py:NAME{near(name, FORMATS)}")
    return name not in FORMATS or FORMATS[name].module == "kit_logs"
