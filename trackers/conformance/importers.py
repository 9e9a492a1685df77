"""The contract of an importer, a function from the path of a log to its tables."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import polars as pl

from trackwright.trackers.conformance.contract import BrokenContract, Check, NotApplicable, Report, report, require_part
from trackwright.trackers.core.errors import UnusableInput, listed, one_line
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.exchange.imported import import_frames
from trackwright.trackers.recordings.checks.all_checks import check
from trackwright.trackers.recordings.folder import RecordingFolder

Importer = Callable[[Path], Mapping[str, Any]]


def check_importer(
    importer: Importer, path: Path | str, rig: Rig | Path | str | None = None, tag: str | None = None
) -> Report:
    """What `importer_checks` find."""
    return report(importer_checks(importer, path, rig, tag))


def importer_checks(
    importer: Importer, path: Path | str, rig: Rig | Path | str | None = None, tag: str | None = None
) -> list[Check]:
    """The checks of a function that reads logs, with one log; `rig` and `tag` as of `import_frames`.

    Its tables are a recording in which `check` finds no error; a second reading gives the same and the log is as it
    was; a text has the same rows with the line ends of another system; of a log that ends early the rows are the
    first rows of the whole, or it is refused by UnusableInput, as an empty one is. Raises UnusableInput for an object
    of another kind.
    """
    require_part("check_importer", importer)
    source, name = Path(path), getattr(importer, "__name__", type(importer).__name__)

    def recording_of(frames: Any) -> RecordingFolder:
        if not isinstance(frames, Mapping) or not frames:
            raise BrokenContract(
                f"{name} gives {type(frames).__name__} of {source.name}, expected frames by the names of tables; usual "
                "fix: return {'ranges': frame}"
            )
        return import_frames(frames, rig, tag=tag)

    def contents() -> dict[Path, tuple[int, int]]:
        """Sizes and times of what is in the log, or beside one that is no folder."""
        there = source.rglob("*") if source.is_dir() else source.parent.iterdir()
        return {file: (of.st_size, of.st_mtime_ns) for file in there if file.exists() for of in [file.stat()]}

    before = cache(contents)

    @cache
    def whole() -> RecordingFolder:
        before()
        return recording_of(importer(source))

    def other_tables(tables: Mapping[str, pl.DataFrame]) -> list[str]:
        """The names of tables that differ from those of the whole log."""
        expected, none = whole().tables, pl.DataFrame()
        names = sorted({*expected, *tables})
        return [one for one in names if not expected.get(one, none).equals(tables.get(one, none))]

    @cache
    def text() -> str:
        if source.is_dir():
            raise NotApplicable("the log is a folder")
        try:
            return source.read_bytes().decode("utf-8")
        except UnicodeDecodeError:
            raise NotApplicable("the log is no text") from None

    def of_text(lines: str) -> dict[str, pl.DataFrame] | None:
        """The tables of a log with another text; None where it is refused."""
        with tempfile.TemporaryDirectory() as scratch:
            log = Path(scratch) / source.name
            log.write_bytes(lines.encode("utf-8"))
            try:
                frames = importer(log)
                return {} if isinstance(frames, Mapping) and not frames else dict(recording_of(frames).tables)
            except UnusableInput:
                return None

    def refused_or_raised(lines: str, what: str) -> dict[str, pl.DataFrame] | None:
        try:
            return of_text(lines)
        except BrokenContract:
            raise
        except Exception as error:
            raise BrokenContract(
                f"{name} stops at {what} by {type(error).__name__}: {one_line(error)[:100]}, expected UnusableInput; "
                "usual fix: raise tw.UnusableInput with the line of the log that is wrong, or skip the line"
            ) from error

    def check_tables() -> str:
        sizes = [f"{table} {len(rows)}" for table, rows in whole().tables.items()]
        if not all(len(rows) for rows in whole().tables.values()):
            raise BrokenContract(
                f"{name} gives a table without rows ({listed(sizes)}), expected tables of what {source.name} has; "
                "usual fix: leave an empty table out"
            )
        return f"rows: {listed(sizes)}"

    def check_again() -> None:
        changed = other_tables(recording_of(importer(source)).tables)
        if changed:
            raise BrokenContract(
                f"{name} gives another table {listed(changed)} when the log is read again, expected the same; usual "
                "fix: nothing kept between calls, and no set whose order differs"
            )
        written = sorted({file.name for file, _ in before().items() ^ contents().items()})
        if written:
            raise BrokenContract(
                f"{name} changes {listed(written)}, expected the log and its folder as they were; usual fix: open it "
                "to read, and write elsewhere"
            )

    def check_recording() -> str:
        found = check(whole())
        errors = [one for one in found if one.level == "error"]
        if errors:
            raise BrokenContract(
                f"`check` of what {name} gives says: {errors[0].where}: {errors[0].message}; usual fix: times in s, "
                "distances in m, angles in rad"
            )
        return f"{len(found)} results, none an error"

    def check_line_ends() -> None:
        plain = text().replace("\r\n", "\n")
        ends = {"\\n": plain, "\\r\\n": plain.replace("\n", "\r\n")}
        for words, lines in ends.items():
            tables = refused_or_raised(lines, f"lines that end with {words}")
            if tables is None or other_tables(tables):
                raise BrokenContract(
                    f"{name} gives other tables where lines end with {words}, expected the same; usual fix: "
                    "path.read_text().splitlines(), which knows both"
                )

    def check_end() -> str:
        lines = text().splitlines(keepends=True)
        tables = refused_or_raised("".join(lines[: (len(lines) + 1) // 2]), "a log that ends early")
        if tables is None:
            return "a log that ends early is refused"
        for table, rows in tables.items():
            first = whole().tables.get(table, rows.clear()).head(len(rows))
            if not rows.equals(first):
                raise BrokenContract(
                    f"{name} gives other rows of {table} for the first half of the log, expected those of the whole; "
                    "usual fix: no number from the end of the log, such as a total or the last time"
                )
        return f"its first half has {sum(map(len, tables.values()))} rows"

    def check_empty() -> str:
        tables = refused_or_raised("", "an empty log")
        if tables and any(len(rows) for rows in tables.values()):
            raise BrokenContract(
                f"{name} gives {max(map(len, tables.values()))} rows of an empty log, expected none; usual fix: rows "
                "from the log alone"
            )
        return "refused" if tables is None else "no rows"

    begun = Check("tables", check_tables)
    return [
        begun,
        Check("again", check_again, begun),
        Check("recording", check_recording, begun),
        Check("line ends", check_line_ends, begun),
        Check("early end", check_end, begun),
        Check("empty log", check_empty, begun),
    ]
