"""A part of a recording: some of its tags, and a span of time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import polars as pl

from trackwright.trackers.core.data.seconds import UNIX_S
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, first_time


@dataclass(frozen=True)
class Selection:
    """Which rows of recordings are used; by default all.

    `tags`: those kept, none for all. `start`, `stop`: s, the rows from `start` to `stop`, both included.
    """

    tags: tuple[str, ...] = ()
    start: float | None = None
    stop: float | None = None

    def of(self, folder: RecordingFolder) -> RecordingFolder:
        """The recording with these rows alone; its truth is the tags', at all times.

        Raises UnusableInput for a tag that the recording lacks, where a table of measurements has no row left, and for
        times after the start of a recording whose times count from 1970.
        """
        if self == Selection():
            return folder
        path = folder.path or folder.name
        present = {tag: None for name in folder.tables for tag in folder.tables[name]["tag"].unique().sort()}
        lacking = [tag for tag in self.tags if tag not in present]
        if lacking:
            raise UnusableInput(f"{path}: no tag {listed(map(repr, lacking))}; its tags: {listed(present, 10)}")
        self._refuse_after_start(first_time(folder.tables), f"{path}: ")
        tables = {}
        for name, table in folder.tables.items():
            rows = table.filter(pl.col("tag").is_in(list(self.tags))) if self.tags else table
            if name in KINDS:
                kept = self._in_time(rows)
                if rows.height and not kept.height:
                    raise UnusableInput(
                        f"{path}: {name} has no row in the span of time asked for; expected a part of {_span(rows)}"
                    )
                rows = kept
            if rows.height:
                tables[name] = rows
        rig = folder.rig
        if self.tags:
            bodies = {body: tuple(tag for tag in on_it if tag in self.tags) for body, on_it in rig.bodies.items()}
            rig = replace(rig, tags={tag: known for tag, known in rig.tags.items() if tag in self.tags}, bodies=bodies)
        return replace(folder, rig=rig, tables=tables)

    def of_estimates(self, tracks: pl.DataFrame) -> pl.DataFrame:
        """The rows of a table of estimates in these tags and times; raises UnusableInput as `of`, or without any."""
        if "t_s" not in tracks.columns:
            return tracks  # what reads them names the column
        if tracks.height:
            self._refuse_after_start(tracks["t_s"].to_numpy().min())
        kept = tracks.filter(pl.col("tag").cast(pl.String).is_in(list(self.tags))) if self.tags else tracks
        kept = self._in_time(kept)
        if not kept.height:
            tags = listed(tracks["tag"].cast(pl.String).unique().sort())
            raise UnusableInput(
                f"no estimate is of these tags and times; expected tags among {tags} and a part of {_span(tracks)}"
            )
        return kept

    def _refuse_after_start(self, first: float, where: str = "") -> None:
        for time in (self.start, self.stop):
            if time is not None and 0.0 < time < UNIX_S <= first:
                raise UnusableInput(
                    f"{where}the times count from 1970, and {time:.12g} s is long before them; {time:.12g} s after the "
                    f"start is {first + time:.12g}"
                )

    def _in_time(self, table: pl.DataFrame) -> pl.DataFrame:
        if self.start is not None:
            table = table.filter(pl.col("t_s") >= self.start)
        return table if self.stop is None else table.filter(pl.col("t_s") <= self.stop)


def _span(table: pl.DataFrame) -> str:
    times = table["t_s"].to_numpy()
    return f"{times.min():.12g} to {times.max():.12g} s"
