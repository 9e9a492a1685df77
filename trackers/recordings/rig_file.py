"""Reader and writer of `rig.toml`, the geometry of a recording; an invalid value is refused with its key."""

from __future__ import annotations

import difflib
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from trackwright.trackers.core.errors import UnusableInput, has_control
from trackwright.trackers.core.model.rig import Rig, Station, Tag, checked_knots
from trackwright.trackers.recordings.input_file import TomlReader

FORMAT = 1
RIG_FILE = "rig.toml"
HIGHEST = 1e5  # metres, of a tag
SHORTEST = 1e-6  # wavelength, m: of light
NORM_TOLERANCE = 1e-3  # for a quaternion written with three decimals

_TOP = ("format", "name", "about", "licence", "source", "anchors", "stations", "tags", "bodies", "path", "floor")
_ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
_STATION = ("position_m", "rotation_wxyz", *_ANGLES, "wavelength_m", "antennas_m")
_TAG = ("height_m", "offset_m")


def read_rig(path: Path) -> tuple[Rig, tuple[str, ...]]:
    """The rig in a `rig.toml`, and a notice for each unknown key; raises UnusableInput."""
    if not os.path.lexists(path):
        raise UnusableInput(
            f"{path}: missing, expected beside the tables, with `format = {FORMAT}`, a name and the geometry; add it"
        )
    reader = _Reader(path, "the geometry of a recording")
    return reader.rig(), tuple(reader.notices)


class _Reader(TomlReader):
    """Converts a `rig.toml` into a `Rig`; `notices`: a line for each unknown key."""

    def __init__(self, path: Path, expected: str) -> None:
        super().__init__(path, expected)
        self.notices: list[str] = []

    def rig(self) -> Rig:
        self.of_format(FORMAT)
        content = self.content
        self.known(content, _TOP, "the top level")
        texts = {key: content.get(key, "") for key in ("name", "about", "licence", "source")}
        for key, text in texts.items():
            if not isinstance(text, str):
                self.wrong(key, text, "a text in quotes")
        anchors, stations, tags, bodies, path, floor = (
            self.table(key, content.get(key, {})) for key in ("anchors", "stations", "tags", "bodies", "path", "floor")
        )
        for text in (texts["name"], *anchors, *stations, *tags, *bodies):
            if has_control(text):
                self.refuse(f"{text!r} has a control character; expected a name without")
        self.known(path, ("knots_m",), "[path]")
        if "path" in content and "knots_m" not in path:
            self.refuse("[path] has no knots_m, expected a list of [x, y] corners in metres")
        self.known(floor, ("walls_m", "outline_m"), "[floor]")
        if "floor" in content and not floor.keys() & {"walls_m", "outline_m"}:
            self.refuse(
                "[floor] has neither walls_m nor outline_m, expected lists of [x1, y1, x2, y2] and of [x, y] corners "
                "in metres"
            )
        return Rig(
            name=texts.pop("name") or self.path.resolve().parent.name,
            anchors={key: self.array(f"anchors.{key}", place, (3,)) for key, place in anchors.items()},
            stations={key: self.station(f"stations.{key}", v) for key, v in stations.items()},
            tags={key: self.tag(f"tags.{key}", v) for key, v in tags.items()},
            bodies=self.bodies(bodies, tags),
            path_knots=self.knots(path["knots_m"]) if path else None,
            walls=self.points("floor.walls_m", floor["walls_m"], 4, 1) if "walls_m" in floor else None,
            outline=self.points("floor.outline_m", floor["outline_m"], 2, 3) if "outline_m" in floor else None,
            **texts,
        )

    def station(self, where: str, content: Any) -> Station:
        self.known(self.table(where, content), _STATION, f"[{where}]")
        for key, named in (("position_m", ("position_m",)), ("rotation_wxyz", ("rotation_wxyz", "yaw_deg"))):
            if not any(name in content for name in named):
                self.refuse(f"[{where}] has no {key}, expected position_m and rotation_wxyz, or yaw_deg instead")
        rotation = self.rotation(where, content)
        antennas = wavelength = None
        given = [key for key in ("antennas_m", "wavelength_m") if key in content]
        if len(given) == 1:
            lack = "wavelength_m" if given == ["antennas_m"] else "antennas_m"
            self.refuse(f"[{where}] has {given[0]} but no {lack}; a station with phases needs both")
        if "antennas_m" in content:
            antennas = self.points(f"{where}.antennas_m", content["antennas_m"])
            wavelength = self.number(f"{where}.wavelength_m", content["wavelength_m"])
            if wavelength < SHORTEST:
                self.wrong(f"{where}.wavelength_m", wavelength, f"a length of at least {SHORTEST:g} m")
        position = self.array(f"{where}.position_m", content["position_m"], (3,))
        return Station(position=position, rotation=rotation, antennas=antennas, wavelength=wavelength)

    def rotation(self, where: str, content: dict[str, Any]) -> np.ndarray:
        """The unit quaternion of a station, given as such or by yaw, pitch and roll."""
        angles = {key: self.number(f"{where}.{key}", content[key]) for key in _ANGLES if key in content}
        if "rotation_wxyz" not in content:
            return mounted(*np.deg2rad([angles.get(key, 0.0) for key in _ANGLES]))
        if angles:
            self.refuse(f"[{where}] has rotation_wxyz and {next(iter(angles))}, expected one of them")
        rotation = self.array(f"{where}.rotation_wxyz", content["rotation_wxyz"], (4,))
        norm = float(np.linalg.norm(rotation))
        if abs(norm - 1) > NORM_TOLERANCE:
            self.refuse(
                f"{where}.rotation_wxyz has length {norm:.4g}, expected a unit quaternion w, x, y, z "
                "(array frame to world frame); no rotation is [1, 0, 0, 0]"
            )
        return rotation / norm

    def tag(self, where: str, content: Any) -> Tag:
        self.known(self.table(where, content), _TAG, f"[{where}]")
        height = self.number(f"{where}.height_m", content["height_m"]) if "height_m" in content else None
        if height is not None and abs(height) > HIGHEST:
            self.wrong(f"{where}.height_m", height, f"metres, at most {HIGHEST:g}")
        return Tag(
            height=height,
            offset=self.array(f"{where}.offset_m", content["offset_m"], (3,)) if "offset_m" in content else None,
        )

    def bodies(self, content: dict[str, Any], tags: dict[str, Any]) -> dict[str, tuple[str, ...]]:
        """The tags of each body, each with a place on it, and on one body alone."""
        bodies: dict[str, tuple[str, ...]] = {}
        for key, body in content.items():
            where = f"bodies.{key}"
            self.known(self.table(where, body), ("tags",), f"[{where}]")
            names = body.get("tags")
            if not isinstance(names, list) or len(names) < 2 or not all(isinstance(name, str) for name in names):
                self.wrong(f"{where}.tags", names, "a list of at least two tags")
            for name in names:
                if "offset_m" not in tags.get(name, {}):
                    self.refuse(f"{where}.tags names {name!r}, which has no offset_m under [tags.{name}]; add it")
                if any(name in other for other in bodies.values()):
                    self.refuse(f"{where}.tags names {name!r}, which is on another body; expected each tag on one")
            bodies[key] = tuple(names)
        return bodies

    def knots(self, value: Any) -> np.ndarray:
        knots = self.points("path.knots_m", value)
        try:
            return checked_knots(knots)
        except ValueError as problem:
            self.refuse(f"path.knots_m: {problem}")

    def points(self, where: str, value: Any, size: int = 2, least: int = 2) -> np.ndarray:
        if not isinstance(value, list) or len(value) < least:
            counts, names = {1: "one", 2: "two", 3: "three"}, {2: "[x, y]", 4: "[x1, y1, x2, y2]"}
            self.wrong(where, value, f"a list of at least {counts[least]} {names[size]} in metres")
        return np.stack([self.array(f"{where}[{i}]", point, (size,)) for i, point in enumerate(value)])

    def known(self, content: Iterable[str], expected: tuple[str, ...], where: str) -> None:
        """Refuses a key that looks misspelt; adds a notice for any other unknown key."""
        for key in content:
            if key in expected:
                continue
            near = difflib.get_close_matches(key.lower(), [e for e in expected if e not in content], 1, 0.7)
            if near:
                self.refuse(f"unknown key {key!r} in {where}, expected {near[0]}; rename it")
            self.notices.append(f"{RIG_FILE}: key {key!r} in {where} is not part of the format and was ignored")


def mounted(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """The unit quaternion w, x, y, z, array frame to world frame, of a station with these angles, rad.

    With zero angles the boresight is along x and the station level. Turned about the world's z by yaw, which is to the
    left, then about its own horizontal axis by pitch, downwards, then about its boresight by roll: Rz Ry Rx of a body
    with x ahead, y left and z up.
    """
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll / 2, pitch / 2, yaw / 2]), np.sin([roll / 2, pitch / 2, yaw / 2])
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    y, z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    # Times (1, 1, 1, 1)/2: the array's x is left, y up and z ahead.
    return np.array([w - x - y - z, w + x + y - z, w - x + y + z, w + x - y + z]) / 2


def rig_text(rig: Rig) -> str:
    """The content of a `rig.toml` that `read_rig` reads back to the same rig; each vector is on one line."""
    parts = [_entries({"format": FORMAT, "name": rig.name})]
    parts[0] += _entries({key: getattr(rig, key) or None for key in ("about", "licence", "source")})
    if rig.anchors:
        parts.append("[anchors]\n" + "".join(f"{_text(key)} = {_value(x)}\n" for key, x in rig.anchors.items()))
    for key, station in rig.stations.items():
        values = {"position_m": station.position, "rotation_wxyz": station.rotation}
        array = {"wavelength_m": station.wavelength, "antennas_m": station.antennas}
        parts.append(f"[stations.{_text(key)}]\n{_entries(values | array)}")
    for key, tag in rig.tags.items():
        parts.append(f"[tags.{_text(key)}]\n{_entries({'height_m': tag.height, 'offset_m': tag.offset})}")
    for key, names in rig.bodies.items():
        parts.append(f"[bodies.{_text(key)}]\ntags = [{', '.join(map(_text, names))}]\n")
    if rig.path_knots is not None:
        parts.append("[path]\n" + _entries({"knots_m": rig.path_knots}))
    if rig.walls is not None or rig.outline is not None:
        parts.append("[floor]\n" + _entries({"walls_m": rig.walls, "outline_m": rig.outline}))
    return "\n".join(parts)


def _entries(values: Mapping[str, Any]) -> str:
    """A line of TOML for each value that is not None."""
    return "".join(f"{key} = {_value(value)}\n" for key, value in values.items() if value is not None)


def _value(value: Any) -> str:
    if isinstance(value, str):
        return _text(value)
    return str(value) if isinstance(value, int) else json.dumps(np.asarray(value, float).tolist())


def _text(value: str) -> str:
    """A TOML basic string: as in JSON, except that TOML requires the delete character to be escaped."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
