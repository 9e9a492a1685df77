"""Serial logs of Decawave and Qorvo kits: `les`, `lec`, `lep` (DWM1001), `mc` (TREK1000), FiRa results (DWM3001C)."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.wording import counted
from trackwright.trackers.exchange.dates import ISO, clock_seconds, date_seconds
from trackwright.trackers.exchange.expressions import Expression, parsed
from trackwright.trackers.exchange.formats import FORMATS
from trackwright.trackers.exchange.mapping import Asked, Source, put
from trackwright.trackers.exchange.source_rows import text_of
from trackwright.trackers.recordings.table_file import TableFile

_N = r"(-?\d+(?:\.\d+)?)"
_ANCHORS = {
    "les": rf"([0-9A-Fa-f]{{4}})\[{_N},{_N},{_N}\]={_N}",
    "lec": rf"AN\d+,([0-9A-Fa-f]{{4}}),{_N},{_N},{_N},{_N}",
}
_POSITION = rf"{_N},{_N},{_N},\d+"
_LINES = {
    "les": rf"(?:{_ANCHORS['les']}\s*)+(?:le_us=\d+\s*)?(?:est\[{_POSITION}\])?",
    "lec": rf"DIST,\d+(?:,{_ANCHORS['lec']})*(?:,POS,{_POSITION})?",
    "lep": rf"POS,{_POSITION}",
}
_TREK = re.compile(
    r"m([acr]) ([0-9a-fA-F]{2}) ((?:[0-9a-fA-F]{8} ){4})[0-9a-fA-F]{4} [0-9a-fA-F]{2} ([0-9a-fA-F]{8}) [at](\d+):\d+"
)
_SHELL = ("dwm>", "DWM1001", "Copyright", "License", "Compiled", "Help")
_EXPECTED = {
    "dwm1001": "lines of the DWM1001 commands les, lec or lep, such as 'DIST,1,AN0,1151,5.00,8.00,2.25,6.44'",
    "les": "a line of les, such as '1151[5.00,8.00,2.25]=6.44 est[2.57,1.98,1.68,100]'",
    "lec": "a line of lec, such as 'DIST,1,AN0,1151,5.00,8.00,2.25,6.44' with as many anchors as it says",
    "lep": "a line of lep, such as 'POS,2.57,1.98,1.68,100'",
    "fira": 'lines such as \'{"Block":0,"results":[{"Addr":"0x0001","Status":"Ok","D_cm":87}]}\'',
    "trek1000": "TREK1000 lines such as 'mc 07 00000663 000005a3 00000512 ffffffff 095f c1 00024c24 a0:0'",
}


class _Line(NamedTuple):
    """What a line says: its readings, columns by table, without time and tag.

    `tag`: where the line names it. `clock`: the time of the device, s, or `block`, the number of its interval, where it
    has one. `failed`: exchanges without a result. `anchors`: places, m.
    """

    readings: Sequence[tuple[str, dict[str, Any]]]
    clock: float | None = None
    block: float | None = None
    failed: int = 0
    anchors: Sequence[tuple[str, tuple[float, ...]]] = ()


def read_source(path: Path, name: str, asked: Asked) -> Source:
    """The readings of a log. Lines of the shell, `mr` and `ma` lines and empty lines are left out.

    Times: the text before the readings of a line, a number (s, or by an expression as `t_s=time in ms`), a date or time
    of day; of TREK1000 lines without it, the time of the last range in ms that they hold; else of line k it is k
    times the interval asked for. DWM1001 lines do not name the tag. Any other line is refused with its number, or left
    out with a notice if that is asked for.
    """
    (mapping,) = asked.mappings
    if {*mapping.columns} - {"t_s"} or mapping.sources - {"time"}:
        raise UnusableInput(f"{path}: {listed(mapping.columns)}: a log has one column, t_s=time, as t_s=time in ms")
    if name == "dwm1001" and mapping.tag is None:
        raise UnusableInput(f"{path}: DWM1001 lines do not name the tag; give it: --tag ID")
    read, begins = {"dwm1001": _dwm1001, "trek1000": _trek1000, "fira": _fira}[name], re.compile(FORMATS[name].begins)
    source, log, bad, raw = Source(), list[tuple[int, str, _Line]](), dict[int, str](), 0
    texts = text_of(path, errors="replace").rstrip().split("\n")
    for number, text in enumerate(map(str.strip, texts), 1):
        begin = begins.search(text)
        if not text or text.startswith("#") or (begin is None and (text.startswith(_SHELL) or name == "fira")):
            continue
        body = text[begin.start() :] if begin else ""
        if name == "trek1000" and body[:2] in ("mr", "ma") and _TREK.fullmatch(body):
            raw += 1
            continue
        line = read(body, mapping.tag, path.stem) if body else name
        if isinstance(line, str):
            cut = "; it is the last line, and looks cut off" * (bool(body) and number == len(texts))
            bad[number] = f"{(body or text)[:60]!r}; expected {_EXPECTED[line]}{cut}"
        else:
            log.append((number, text[: len(text) - len(body)].strip().removesuffix("dwm>").strip(" \t,;|:[]->"), line))
    times = _times([before for _, before, _ in log], mapping.expressions.get("t_s", parsed("t_s", "time")))
    tables: dict[str, list[dict[str, Any]]] = {}
    for k, (time, (number, before, line)) in enumerate(zip(times, log, strict=True)):
        if not before and line.clock is not None:
            time = line.clock
        elif not before and asked.interval is not None:
            time = asked.interval * (k if line.block is None else line.block)
        try:
            if time is None and before:
                kinds = "seconds, a date such as 2026-05-01T12:00:00.25, or a time of day such as 12:00:00.25"
                raise UnusableInput(f"{before[:40]!r} before the readings; expected {kinds}")
            if time is None:
                fix = "log with time stamps, or give the interval of the lines: --interval 0.1"
                raise UnusableInput(f"no time before the readings; {fix}")
            other = next((row["tag"] for _, row in line.readings if row.get("tag", mapping.tag) != mapping.tag), None)
            if other is not None and mapping.tag is not None:
                raise UnusableInput(f"is of tag {other}, which --tag {mapping.tag} would rename; leave --tag out")
            for anchor, place in line.anchors:
                put(source.anchors, "", anchor, place)
        except UnusableInput as problem:
            bad[number] = str(problem).removeprefix(": ")
            continue
        for table, row in line.readings:
            tables.setdefault(table, []).append({"t_s": time, "tag": mapping.tag, **row})
    if bad and not asked.skip:
        raise UnusableInput(f"{path}: line {min(bad)}: {bad[min(bad)]}; --skip-bad-lines leaves such lines out")
    if not tables:
        raise UnusableInput(f"{path}: no readings; expected {_EXPECTED[name]}")
    if failed := sum(line.failed for number, _, line in log if number not in bad):
        source.notices.append(f"{counted(failed, 'exchange')} without a result left out")
    if bad:
        source.notices.append(f"{counted(len(bad), 'line')} could not be read, left out: {listed(sorted(bad))}")
    if raw:
        source.notices.append(f"{counted(raw, 'line')} of raw (mr) and anchor (ma) ranges left out; mc lines are used")
    for table in sorted(tables, key=("ranges", "fixes", "bearings").index):
        source.tables[table] = pl.DataFrame(tables[table], infer_schema_length=None)
    return source


def _times(texts: Sequence[str], seconds: Expression) -> pl.Series:
    """The times, s, that stand before readings: numbers by the expression, dates and times of day; null for others."""
    given = pl.Series("time", texts, dtype=pl.String)
    numbers = pl.DataFrame({"time": given.cast(pl.Float64, strict=False)})
    columns = [
        seconds.values(TableFile(Path("log"), numbers), "t_s"),
        clock_seconds(given),
        date_seconds(given, ISO)[0],
    ]
    return pl.select(pl.coalesce(*columns)).to_series()


def _dwm1001(body: str, tag: str | None, name: str) -> _Line | str:
    form = "lep" if body.startswith("POS") else "lec" if body.startswith("DIST") else "les"
    line = re.fullmatch(_LINES[form], body)
    seen = re.findall(_ANCHORS[form], body) if form in _ANCHORS else []
    if line is None or (form == "lec" and int(body.split(",")[1]) != len(seen)):
        return form
    position = dict(zip(("x_m", "y_m", "z_m"), map(float, filter(None, line.groups()[-3:])), strict=False))
    readings = [("ranges", {"anchor": anchor, "range_m": float(distance)}) for anchor, *_, distance in seen]
    anchors = [(anchor, (float(x), float(y), float(z))) for anchor, x, y, z, _ in seen]
    return _Line([*readings, *([("fixes", position)] if position else [])], anchors=anchors)


def _trek1000(body: str, tag: str | None, name: str) -> _Line | str:
    match = _TREK.fullmatch(body)
    if match is None or match[1] != "c":
        return "trek1000"
    mask, ranges = int(match[2], 16), [int(text, 16) for text in match[3].split()]
    seen = [(str(k), mm / 1000) for k, mm in enumerate(ranges) if mask >> k & 1 and mm < 0x8000_0000]
    readings = [("ranges", {"tag": match[5], "anchor": anchor, "range_m": distance}) for anchor, distance in seen]
    return _Line(readings, int(match[4], 16) / 1000)


def _fira(body: str, tag: str | None, name: str) -> _Line | str:
    """A line of the makers' FiRa application (INITF).

    Of a kit that is a tag, the distances to the others as anchors, and the angle at which these saw it; else of the kit
    as an anchor, named as the file, the distances to the others as tags and the angles at which it saw them.
    """
    try:
        content = json.loads(body)
        results = [(str(r["Addr"]).removeprefix("0x"), r) for r in content["results"]]
        block = float(content["Block"])
    except (ValueError, KeyError, TypeError):
        return "fira"
    readings, failed = [], 0
    for other, result in results:
        distance, angle = result.get("D_cm"), result.get("LAoA_deg" if tag is None else "RAoA_deg")
        if result.get("Status") != "Ok" or not isinstance(distance, int | float):
            failed += 1
            continue
        mobile, fixed = (other, name) if tag is None else (tag, other)
        readings.append(("ranges", {"tag": mobile, "anchor": fixed, "range_m": distance / 100}))
        # Kits without an array of antennas print zeros with no figure of merit.
        if isinstance(angle, int | float) and (angle or result.get("LFoM")):
            seen = {"azimuth_rad": math.radians(angle), "elevation_rad": None}
            readings.append(("bearings", {"tag": mobile, "station": fixed, **seen}))
    return _Line(readings, block=block, failed=failed)
