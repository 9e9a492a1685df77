"""Serial logs of Decawave and Qorvo kits: `les`, `lec`, `lep` (DWM1001), `mc` (TREK1000), FiRa results (DWM3001C)."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.wording import counted
from trackwright.trackers.exchange.expressions import Expression
from trackwright.trackers.exchange.formats import FORMATS
from trackwright.trackers.exchange.mapping import Asked, Source, put
from trackwright.trackers.exchange.source_rows import text_of
from trackwright.trackers.exchange.trajectories import AXES

_N = r"-?\d+(?:\.\d+)?"
_LES = re.compile(rf"([0-9A-Fa-f]{{4}})\[({_N}),({_N}),({_N})\]=({_N})")
_ESTIMATE = re.compile(rf"est\[({_N}),({_N}),({_N}),(\d+)\]")
_LES_LINE = re.compile(rf"(?:{_LES.pattern}\s*)+(?:le_us=\d+\s*)?(?:{_ESTIMATE.pattern})?")
_LEC = re.compile(rf"AN\d+,([0-9A-Fa-f]{{4}}),({_N}),({_N}),({_N}),({_N})")
_POS = re.compile(rf"POS,({_N}),({_N}),({_N}),(\d+)")
_LEC_LINE = re.compile(rf"DIST,(\d+)((?:,{_LEC.pattern})*)(?:,{_POS.pattern})?")
_TREK = re.compile(
    r"m([acr]) ([0-9a-fA-F]{2}) ((?:[0-9a-fA-F]{8} ){4})([0-9a-fA-F]{4}) ([0-9a-fA-F]{2}) ([0-9a-fA-F]{8}) "
    r"([at])(\d+):(\d+)"
)
_CLOCK = re.compile(r"(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d+)?)")
_SHELL = ("dwm>", "DWM1001", "Copyright", "License", "Compiled", "Help")
_DAY = 86400.0
_TIME = Expression("time", source="time")
"""The expression of the number before the readings of a line, for `t_s`."""


def read_source(path: Path, name: str, asked: Asked) -> Source:
    """The readings of a log. Lines of the shell, `mr` and `ma` lines and empty lines are left out.

    Times: the text before the readings of a line, a number (s, or by an expression as `t_s=time in ms`), a date or time
    of day; of TREK1000 lines without it, the time of the last range in ms that they hold; else that of line k is k
    times the interval asked for. DWM1001 lines do not name the tag. Any other line is refused with its number, or left
    out with a notice if that is asked for.
    """
    (mapping,) = asked.mappings
    time = mapping.columns.get("t_s", _TIME)
    if mapping.columns.keys() - {"t_s"} or time.source != "time":
        raise UnusableInput(f"{path}: {listed(mapping.columns)}: a log has one column, t_s=time, as t_s=time in ms")
    if name == "dwm1001" and mapping.tag is None:
        raise UnusableInput(f"{path}: DWM1001 lines do not name the tag; give it: --tag ID")
    log, bad, raw = _Log(mapping.tag, asked.interval, time, path.stem), [], 0
    read = {"dwm1001": log.dwm1001, "trek1000": log.trek1000, "fira": log.fira}[name]
    begins = FORMATS[name].begins
    assert begins is not None
    lines = text_of(path, errors="replace").rstrip().splitlines()
    for number, line in enumerate(lines, 1):
        line, where = line.strip(), f"{path}: line {number}"
        begin = begins.search(line)
        if not line or line.startswith("#") or (begin is None and (line.startswith(_SHELL) or name == "fira")):
            continue
        body = "" if begin is None else line[begin.start() :]
        if name == "trek1000" and body[:2] in ("mr", "ma") and _TREK.fullmatch(body):
            raw += 1
            continue
        try:
            if begin is None:
                raise UnusableInput(f"{where}: {line[:60]!r}; expected {_EXPECTED[name]}")
            read(where, body, line[: begin.start()])
        except UnusableInput as problem:
            if not asked.skip:
                last = isinstance(problem, _NoSuchLine) and number == len(lines)
                cut = "; it is the last line, and looks cut off" if last else ""
                raise UnusableInput(f"{problem}{cut}; --skip-bad-lines leaves such lines out") from problem
            bad.append(number)
    if not log.ranges and not log.fixes:
        raise UnusableInput(f"{path}: no readings; expected {_EXPECTED[name]}")
    source = Source(anchors=log.anchors)
    if log.failed:
        source.notices.append(f"{counted(log.failed, 'exchange')} without a result left out")
    if bad:
        shown = ", ".join(map(str, bad[:5])) + (" …" if len(bad) > 5 else "")
        source.notices.append(f"{counted(len(bad), 'line')} could not be read, left out: {shown}")
    if raw:
        source.notices.append(f"{counted(raw, 'line')} of raw (mr) and anchor (ma) ranges left out; mc lines are used")
    angles = ("station", "azimuth_rad", "elevation_rad")
    kinds = (
        ("ranges", log.ranges, ("anchor", "range_m")),
        ("fixes", log.fixes, AXES),
        ("bearings", log.bearings, angles),
    )
    for table, rows, values in kinds:
        if rows:
            source.tables[table] = pl.DataFrame(rows, ["t_s", "tag", *values], orient="row")
    return source


_EXPECTED = {
    "dwm1001": "lines of the DWM1001 commands les, lec or lep, such as 'DIST,1,AN0,1151,5.00,8.00,2.25,6.44'",
    "les": "a line of les, such as '1151[5.00,8.00,2.25]=6.44 est[2.57,1.98,1.68,100]'",
    "lec": "a line of lec, such as 'DIST,1,AN0,1151,5.00,8.00,2.25,6.44' with as many anchors as it says",
    "lep": "a line of lep, such as 'POS,2.57,1.98,1.68,100'",
    "fira": 'lines such as \'{"Block":0,"results":[{"Addr":"0x0001","Status":"Ok","D_cm":87}]}\'',
    "trek1000": "TREK1000 lines such as 'mc 07 00000663 000005a3 00000512 ffffffff 095f c1 00024c24 a0:0'",
}


class _NoSuchLine(UnusableInput):
    """A line with readings that has not the form of its command, as one that was cut off."""


@dataclass
class _Log:
    """The rows of a log; `anchors`: the positions, m, that it names. `lines`, `days`, `latest`: of its clock so far.

    `name`: of the file. `failed`: exchanges without a result.
    """

    tag: str | None
    interval: float | None
    time: Expression
    name: str
    ranges: list[tuple[float, str, str, float]] = field(default_factory=list)
    fixes: list[tuple[float, str, float, float, float]] = field(default_factory=list)
    bearings: list[tuple[float, str, str, float, None]] = field(default_factory=list)
    anchors: dict[str, tuple[float, ...]] = field(default_factory=dict)
    failed: int = 0
    lines: int = 0
    days: int = 0
    latest: float = -1.0

    def time_of(self, where: str, prefix: str, device: float | None = None) -> float:
        """The time, s, of a line with this text before its readings, or else that of the device.

        Times of day go on after midnight.
        """
        prefix = prefix.strip().removesuffix("dwm>").strip(" \t,;|:[]->")
        self.lines += 1
        if not prefix:
            if device is None and self.interval is None:
                raise UnusableInput(
                    f"{where}: no time before the readings; log with time stamps, or give the interval of the lines: "
                    "--interval 0.1"
                )
            return device if device is not None else (self.lines - 1) * float(self.interval or 0.0)
        if day := _CLOCK.fullmatch(prefix):
            seconds = int(day[1]) * 3600 + int(day[2]) * 60 + float(day[3].replace(",", "."))
            self.days += seconds < self.latest - _DAY / 2
            self.latest = seconds
            return seconds + self.days * _DAY
        try:
            return float(prefix) * self.time.factor + self.time.shift
        except ValueError:
            pass
        try:
            date = datetime.fromisoformat(prefix.replace(",", "."))
        except ValueError:
            raise UnusableInput(
                f"{where}: {prefix[:40]!r} before the readings; expected seconds, a date such as "
                "2026-05-01T12:00:00.25, or a time of day such as 12:00:00.25"
            ) from None
        return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()

    def dwm1001(self, where: str, body: str, prefix: str) -> None:
        """Adds the readings of a line; raises UnusableInput."""
        if body.startswith("POS"):
            command, readings, position = "lep", [], _POS.fullmatch(body)
            understood = position is not None
        elif body.startswith("DIST"):
            command, readings, position = "lec", _LEC.findall(body), _POS.search(body)
            line = _LEC_LINE.fullmatch(body)
            understood = line is not None and int(line[1]) == len(readings)
        else:
            command, readings, position = "les", _LES.findall(body), _ESTIMATE.search(body)
            understood = _LES_LINE.fullmatch(body) is not None
        if not understood:
            raise _NoSuchLine(f"{where}: {body[:60]!r}; expected {_EXPECTED[command]}")
        time = self.time_of(where, prefix)
        for anchor, x, y, z, distance in readings:
            put(self.anchors, where, anchor, (float(x), float(y), float(z)))
            self.ranges.append((time, str(self.tag), anchor, float(distance)))
        if position is not None:
            x, y, z = (float(position[k]) for k in (1, 2, 3))
            self.fixes.append((time, str(self.tag), x, y, z))

    def trek1000(self, where: str, body: str, prefix: str) -> None:
        """Adds the readings of a line; raises UnusableInput."""
        match = _TREK.fullmatch(body)
        if match is None or match[1] != "c":
            raise _NoSuchLine(f"{where}: {body[:60]!r}; expected {_EXPECTED['trek1000']}")
        mask, ranges = int(match[2], 16), [int(text, 16) for text in match[3].split()]
        if self.tag not in (None, match[8]):
            raise UnusableInput(f"{where}: is of tag {match[8]}, which --tag {self.tag} would rename; leave --tag out")
        time = self.time_of(where, prefix, int(match[6], 16) / 1000)
        for k, millimetres in enumerate(ranges):
            if mask >> k & 1 and millimetres < 0x8000_0000:
                self.ranges.append((time, match[8], str(k), millimetres / 1000))

    def fira(self, where: str, body: str, prefix: str) -> None:
        """Adds the readings of a line of the makers' FiRa application (INITF); raises UnusableInput.

        Of a kit that is a tag, the distances to the others as anchors, and the angle at which these saw it; else of the
        kit as an anchor, named as the file, the distances to the others as tags and the angles at which it saw them.
        """
        try:
            content = json.loads(body)
            results = [(str(r["Addr"]).removeprefix("0x"), r) for r in content["results"]]
            block = float(content["Block"])
        except (ValueError, KeyError, TypeError):
            raise _NoSuchLine(f"{where}: {body[:60]!r}; expected {_EXPECTED['fira']}") from None
        time = self.time_of(where, prefix, None if self.interval is None else block * self.interval)
        for other, result in results:
            distance = result.get("D_cm")
            if result.get("Status") != "Ok" or not isinstance(distance, int | float):
                self.failed += 1
                continue
            tag, fixed = (other, self.name) if self.tag is None else (self.tag, other)
            self.ranges.append((time, tag, fixed, distance / 100))
            angle = result.get("LAoA_deg" if self.tag is None else "RAoA_deg")
            # Kits without an array of antennas print zeros with no figure of merit.
            if isinstance(angle, int | float) and (angle or result.get("LFoM")):
                self.bearings.append((time, tag, fixed, math.radians(angle), None))
