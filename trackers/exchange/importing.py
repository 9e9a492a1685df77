"""The import of one source into a recording folder, from format and mapping to the frame of its truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from trackwright.trackers.core.data.seconds import moment
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.exchange.formats import format_of, has_tables
from trackwright.trackers.exchange.imported import assembled, origin_of, read_geometry, read_source, save, since
from trackwright.trackers.exchange.mapping import PRESETS, Asked, MappingFile, TableMapping, read_mapping
from trackwright.trackers.exchange.truth_frame import with_truth_moved
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording
from trackwright.trackers.recordings.rig_file import RIG_FILE


@dataclass(frozen=True)
class Import:
    """What is imported from `source` into the recording folder `out`, with the options of `trackwright import`.

    `given`: one table, which was `named` or not; `say` gets each notice.
    """

    source: Path
    out: Path
    given: TableMapping
    named: bool = True
    mapping: Path | None = None
    format: str | None = None
    rig: Path | None = None
    origin: str | None = None
    transform: str | None = None
    align_truth: Sequence[str] | None = None
    interval: float | None = None
    skip_bad_lines: bool = False
    messages: tuple[Path, ...] = ()
    replace: bool = False
    say: Callable[[str], None] = lambda line: None

    def run(self) -> tuple[Mapping[str, pl.DataFrame], RecordingFolder]:
        """The tables that were imported, and the recording that was written; raises UnusableInput."""
        source, mapping, out = self.source, self.mapping, self.out
        preset = MappingFile() if mapping is None else read_mapping(mapping)
        name = self.format or ("csv" if any(one.file for one in preset.tables) else format_of(source))
        asked = [one for one in preset.tables if (one.topic is not None) == (name == "ros")] or preset.tables
        if left := [one.table for one in preset.tables if one not in asked]:
            kind = "other files" if name == "ros" else "bags"
            self.say(f"notice: {mapping}: its entries for {kind} are skipped ({', '.join(left)})")
        self.say(f"{source}: read as {name}" + ("" if self.format else "; another format: --format"))
        mappings, there = self._mappings(has_tables(name), asked), (out / RIG_FILE).is_file()
        if self.origin == "start" and there:
            words = "expected their origin, as its first import printed it: --origin SECONDS, or none if it had none"
            raise UnusableInput(f"--origin start: {out} has tables already; {words}")
        geometry, anchors, lines = read_geometry(self.rig, out, preset, self.given)
        try:
            imported = read_source(source, name, Asked(mappings, self.interval, self.skip_bad_lines, self.messages))
        except UnusableInput as problem:
            text, add, _ = str(problem).partition("; add --columns")
            if mapping is None or not add:
                raise
            raise UnusableInput(f"{text}; another mapping? presets: {', '.join(sorted(PRESETS))}") from None
        tables = imported.tables
        if self.origin is not None:
            begin = origin_of(self.origin, tables)
            tables = since(tables, begin)
            lines = [f"t_s = 0 is {moment(begin)} of {source}; give further tables the same --origin {begin!r}", *lines]
        # Recordings of one installation share its rig, but not their name.
        title = None if there else out.resolve().name
        folder = assembled(title, geometry, tables, anchors or imported.anchors, preset)
        lines = [*imported.notices, *lines]
        if self.transform is not None or self.align_truth is not None:
            recording = read_recording(out) if there else folder
            folder, said = with_truth_moved(folder, recording, self.transform, bool(self.align_truth))
            lines += said
        written = save(folder, out, imported, self.replace)
        for line in (*lines, *(f"{out}: {line}" for line in written.notices)):
            self.say(f"notice: {line}")
        return tables, written

    def _mappings(self, own_tables: bool, tables: Sequence[TableMapping]) -> list[TableMapping]:
        """The mappings of the tables of the source: the one `given`, or the `tables` of the file of --mapping."""
        given = self.given
        if tables:
            if own_tables:
                raise UnusableInput("--mapping: a file of this format has its tables; leave it out")
            if self.named or given != TableMapping(table="ranges", tag=given.tag):
                raise UnusableInput(
                    "--mapping and --table, --columns, --topic or the form of a text; give one or the other"
                )
            return [m if m.tag else dataclasses.replace(m, tag=given.tag) for m in tables]
        if own_tables and (self.named or given.topic is not None):
            raise UnusableInput(f"{self.source}: a file of this format has its tables; leave --table and --topic out")
        if given.columns and not (self.named or own_tables):
            raise UnusableInput("--columns without --table; expected --table ranges, fixes, truth or another table")
        return [given] if self.named or own_tables else []
