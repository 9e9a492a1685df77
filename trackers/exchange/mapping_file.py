"""Mappings in TOML files: those of users, and the presets of the program for logs of public data sets and kits."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

from trackwright.trackers.core.errors import UnusableInput, listed, near
from trackwright.trackers.exchange.expressions import columns_of
from trackwright.trackers.exchange.mapping import TableMapping, checked, put
from trackwright.trackers.exchange.source_rows import Reading
from trackwright.trackers.recordings.input_file import file_bytes, read_toml
from trackwright.trackers.recordings.kinds import table_kinds

PRESETS = {path.stem: path for path in (Path(__file__).parent / "presets").glob("*.toml")}
"""The presets by name; the head of each says what it reads, the units and frames, and where anchors come from."""

_READING = {f.name for f in fields(Reading)}
_TEXTS = ("table", "topic", "tag", "file", *sorted(_READING - {"skip", "missing"}))
_KEYS = (*_TEXTS, "skip", "missing", "columns", "where", "anchors", "body")


class MappingFile(NamedTuple):
    """The mappings of `tables`; those with a topic are for bags, the others for other files.

    `anchors`: the pattern of an anchor in a text file of positions, with the groups anchor, x, y, z, m. `offsets`: the
    places of tags on their body, (3,) m. `bodies`: the tags of each, where there are several.
    """

    tables: Sequence[TableMapping]
    anchors: str | None = None
    offsets: Mapping[str, Sequence[float]] = {}
    bodies: Mapping[str, Sequence[str]] = {}

    def positions(self, path: Path) -> dict[str, tuple[float, ...]]:
        """The positions of anchors, m, in a text file of the makers; raises UnusableInput."""
        anchors: dict[str, tuple[float, ...]] = {}
        try:
            for match in re.finditer(str(self.anchors), file_bytes(path).decode("utf-8")):
                put(anchors, f"--rig {path}", match["anchor"], tuple(float(match[axis]) for axis in "xyz"))
        except (OSError, ValueError) as error:
            raise UnusableInput(f"--rig {path}: cannot be read ({error}); expected positions of anchors") from error
        if not anchors:
            raise UnusableInput(f"--rig {path}: no anchor in it; expected the makers' file, or a rig.toml")
        return anchors


def read_mapping(path: Path) -> MappingFile:
    """The mappings of a preset, by its name, or of a TOML file with entries [[tables]]; raises UnusableInput."""
    expected = f"entries [[tables]], or a preset by name: {', '.join(sorted(PRESETS))}{near(str(path), PRESETS)}"
    path = PRESETS.get(str(path), path)
    content = read_toml(path, expected)
    entries, anchors, tags, bodies = (content.pop(key, None) for key in ("tables", "anchors", "tags", "bodies"))
    if isinstance(entries, dict):
        raise UnusableInput(f"{path}: [tables] is one table, expected a list of them; write [[tables]]")
    if content or not isinstance(entries, list) or not entries or not all(isinstance(e, dict) for e in entries):
        raise UnusableInput(
            f"{path}: keys {listed(content) or 'none'}{'' if entries is None else ', tables'}; expected entries "
            "[[tables]], each with table and columns, and where needed anchors, [tags.ID], [bodies.ID]"
        )
    try:
        offsets = {tag: [float(x) for x in one["offset_m"]] for tag, one in (tags or {}).items()}
        carried = {body: [str(tag) for tag in one["tags"]] for body, one in (bodies or {}).items()}
        groups = {"anchor", *"xyz"} if anchors is None else set(re.compile(anchors).groupindex)
        if groups != {"anchor", *"xyz"} or any(len(offset) != 3 for offset in offsets.values()):
            raise ValueError
    except (AttributeError, KeyError, TypeError, ValueError, re.error) as error:
        raise UnusableInput(
            f"{path}: anchors, tags or bodies; expected a pattern with groups anchor, x, y, z, offset_m = [x, y, z] of "
            "each tag and tags = [ID, …] of each body"
        ) from error
    tables = [_entry(f"{path}: [[tables]] {k}", entry, offsets) for k, entry in enumerate(entries, 1)]
    return MappingFile(tables, anchors, offsets, carried)


def _entry(where: str, entry: dict[str, Any], offsets: Mapping[str, Sequence[float]]) -> TableMapping:
    unknown = [key for key in entry if key not in _KEYS]
    if unknown:
        raise UnusableInput(f"{where}: unknown key {unknown[0]!r}; expected {', '.join(_KEYS)}")
    if "table" not in entry:
        raise UnusableInput(f"{where}: no table; expected one of {', '.join(table_kinds())}")
    texts = {key: entry[key] for key in _TEXTS if key in entry}
    parts = {key: entry.get(key, {}) for key in ("columns", "anchors", "where")}
    found = [f"{key} = {x!r}" for key, x in parts.items() if not isinstance(x, dict)]
    columns, anchors, rows = ({} if found else part for part in parts.values())
    found += [f"{k} = {x!r}" for one in (texts, columns, anchors) for k, x in one.items() if not isinstance(x, str)]
    found += [f"{column} = {x!r}" for column, x in rows.items() if not isinstance(x, list)]
    missing, skip = entry.get("missing", []), entry.get("skip", 0)
    found += [f"missing = {missing!r}"] * (not isinstance(missing, list)) + [f"skip = {skip!r}"] * (
        not isinstance(skip, int)
    )
    if anchors and (set(anchors) != {"x_m", "y_m", "z_m"} or "anchor" not in columns):
        found.append(f"anchors with {listed(anchors)}, columns with {listed(columns) or 'none'}")
    if found:
        raise UnusableInput(
            f'{where}: {found[0][:80]}; expected texts, in columns TARGET = "EXPRESSION", as in anchors for x_m, y_m '
            "and z_m beside a column of anchor, and in where COLUMN = [VALUE, …]"
        )
    kept = {column: [str(value) for value in values] for column, values in rows.items()}
    try:
        columns, anchors = (columns_of([f"{k}={v}" for k, v in one.items()]) for one in (columns, anchors))
        of_body = offsets if entry.get("body") else {}
        how = {key: texts.pop(key) for key in _READING & texts.keys()}
        reading = Reading(**how, skip=skip, missing=tuple(map(str, missing)))
        return checked(
            TableMapping(columns=columns, where=kept, anchors=anchors, offsets=of_body, reading=reading, **texts)
        )
    except UnusableInput as problem:
        raise UnusableInput(f"{where}: {problem}") from problem
