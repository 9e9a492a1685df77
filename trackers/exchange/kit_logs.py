"""Serial logs of Decawave and Qorvo kits: `les`, `lec`, `lep` (DWM1001), `mc` (TREK1000), FiRa results (DWM3001C)."""

from __future__ import annotations

import json
import math
import re
from itertools import count
from pathlib import Path
from typing import Any

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.wording import counted
from trackwright.trackers.exchange.formats import FORMATS
from trackwright.trackers.exchange.mapping import Asked, Source, TableMapping
from trackwright.trackers.exchange.text_tables import BEFORE, read_lines, text_of
from trackwright.trackers.recordings.tables import TableFile

Rows = list[tuple[str, dict[str, Any]]]  # the rows that a line says, each with its table

_N = r"(-?\d+(?:\.\d+)?)"
_ANCHOR = rf"(?:,?AN\d+,|)([0-9A-Fa-f]{{4}})[\[,]{_N},{_N},{_N}(?:\]=|,){_N}\s*"
_PLACE = rf",?(?:POS,|est\[){_N},{_N},{_N},\d+\]?"
_DWM1001 = re.compile(rf"(?:DIST,(?P<count>\d+))?(?P<anchors>(?:{_ANCHOR})*)(?:le_us=\d+\s*)?(?:{_PLACE})?")
_TREK = re.compile(
    r"m([acr]) ([0-9a-fA-F]{2}) ((?:[0-9a-fA-F]{8} ){4})[0-9a-fA-F]{4} [0-9a-fA-F]{2} ([0-9a-fA-F]{8}) [at](\d+):\d+"
)
_SHELL = ("dwm>", "DWM1001", "Copyright", "License", "Compiled", "Help")
_TIMES = {
    "time": r"[-+]?\d+\.?\d*(?:e\d+)?|",
    "time in hh:mm:ss": r"\d\d?:\d\d\S*",
    "time in iso": r"\d{4}-\d\d-\d\d.*",
}
_LINES = {
    "dwm1001": "a whole line of les, lec or lep, as DIST,1,AN0,1151,5.00,8.00,2.25,6.44,POS,2.57,1.98,1.68,100",
    "trek1000": "a line as mc 07 00000663 000005a3 00000512 ffffffff 095f c1 00024c24 a0:0",
    "fira": 'a line as {"Block":0,"results":[{"Addr":"0x0001","Status":"Ok","D_cm":87}]}',
}


def read_source(path: Path, name: str, asked: Asked) -> Source:
    """The readings of a log; lines of the shell and raw ones of TREK1000 are left out.

    The time stands before the readings; without, it is a TREK1000's, or the line's number or Block times the interval.
    """
    (mapping,), begins, number = asked.mappings, re.compile(FORMATS[name].begins), count()
    if {*mapping.columns} - {"t_s"} or mapping.sources - {"time"}:
        raise UnusableInput(f"{path}: {listed(mapping.columns)}: a log has one column, t_s=time, as t_s=time in ms")
    if name == "dwm1001" and mapping.tag is None:
        raise UnusableInput(f"{path}: DWM1001 lines do not name the tag; give it: --tag ID")

    def parse(line: str) -> list[dict[str, Any]]:
        begin = begins.search(line)
        if begin is None and (line.startswith(_SHELL) or name == "fira"):
            return []
        body = line[begin.start() :] if begin else ""
        before = line[: len(line) - len(body)].strip().removesuffix("dwm>").strip(BEFORE)
        if not any(re.fullmatch(pattern, before) for pattern in _TIMES.values()):
            raise ValueError(f"{before!r} is no time")
        (clock, rows), k = _KITS[name](body, mapping.tag, path.stem), next(number)
        if name != "trek1000":
            clock = None if asked.interval is None else asked.interval * (k if clock is None else clock)
        time = before or (None if clock is None else repr(clock))
        return [{"table": table, "before": before, "row": {"time": time, **row}} for table, row in rows]

    text, expected = text_of(path, errors="replace"), f"a time in s, a date or a time of day, and {_LINES[name]}"
    rows, lines, notices = read_lines(path, text, parse, asked.skip, expected)
    if raw := sum(row["table"] == "raw" for row in rows):
        notices.append(f"{counted(raw, 'line')} of raw (mr) and anchor (ma) ranges left out; mc lines are used")
    source, given = Source(notices=notices), next((row["before"] for row in rows if row["before"]), "")
    form = next(form for form, pattern in _TIMES.items() if re.fullmatch(pattern, given))
    if not given and name != "trek1000" and asked.interval is None:
        fix = "log with time stamps, or give the interval of the lines: --interval 0.1"
        raise UnusableInput(f"{path}: line {lines[0]}: no time before the readings; {fix}")
    for table in ("ranges", "fixes", "bearings"):
        if own := [(line, row["row"]) for line, row in zip(lines, rows, strict=True) if row["table"] == table]:
            frame = pl.DataFrame([row for _, row in own], infer_schema_length=None)
            places = {f"{a}_m": f"a{a}" for a in "xyz" if f"a{a}" in frame.columns}
            columns = {"t_s": mapping.columns.get("t_s", form)} | ({"anchor": "anchor"} if places else {})
            file = TableFile(path, frame, [line for line, _ in own])
            source.read(file, TableMapping(table=table, columns=columns, tag=mapping.tag, anchors=places))
    return source


def _dwm1001(body: str, tag: str | None, name: str) -> tuple[float | None, Rows]:
    line = _DWM1001.fullmatch(body)
    seen = re.findall(_ANCHOR, line["anchors"]) if line else []
    if not body or line is None or (line["count"] and int(line["count"]) != len(seen)):
        raise ValueError("is cut off, or of another kind")
    names, rows = ("ax", "ay", "az", "range_m"), Rows()
    for anchor, *numbers in seen:
        rows.append(("ranges", {"anchor": anchor} | dict(zip(names, map(float, numbers), strict=True))))
    if place := re.search(rf"{_PLACE}$", body):
        rows.append(("fixes", dict(zip(("x_m", "y_m", "z_m"), map(float, place.groups()), strict=True))))
    return None, rows


def _trek1000(body: str, tag: str | None, name: str) -> tuple[float | None, Rows]:
    match = _TREK.fullmatch(body)
    if match is None:
        raise ValueError("is cut off, or of another kind")
    mask, ranges = int(match[2], 16), [int(text, 16) for text in match[3].split()]
    seen = [(str(k), mm / 1000) for k, mm in enumerate(ranges) if mask >> k & 1 and mm < 0x8000_0000]
    rows: Rows = [("ranges", {"tag": match[5], "anchor": anchor, "range_m": d}) for anchor, d in seen]
    return int(match[4], 16) / 1000, rows if match[1] == "c" else [("raw", {})]


def _fira(body: str, tag: str | None, name: str) -> tuple[float | None, Rows]:
    """Distances and angles from a kit that is the `tag` to anchors, or from an anchor, named as the file, to tags."""
    content, rows = json.loads(body), Rows()
    for result in content["results"]:
        other, distance = str(result["Addr"]).removeprefix("0x"), result.get("D_cm")
        angle = result.get("LAoA_deg" if tag is None else "RAoA_deg")
        ok = result.get("Status") == "Ok" and isinstance(distance, int | float)
        mobile, fixed = (other, name) if tag is None else (tag, other)
        rows.append(("ranges", {"tag": mobile, "anchor": fixed, "range_m": distance / 100 if ok else None}))
        # Kits without an array of antennas print zeros with no figure of merit.
        if ok and isinstance(angle, int | float) and (angle or result.get("LFoM")):
            seen = {"azimuth_rad": math.radians(angle), "elevation_rad": None}
            rows.append(("bearings", {"tag": mobile, "station": fixed, **seen}))
    return float(content["Block"]), rows


_KITS = {"dwm1001": _dwm1001, "trek1000": _trek1000, "fira": _fira}
