"""`rig.toml`: reads it into a `Rig` and writes a `Rig` back. Whatever is wrong is refused with the key it stands at."""

from __future__ import annotations

import difflib
import json
import math
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from trackers.core.errors import UnusableInput
from trackers.core.polyline import Polyline
from trackers.core.rig import Rig, Station, Tag

FORMAT = 1
RIG_FILE = "rig.toml"
NORM_TOLERANCE = 1e-3  # of a quaternion written with three decimals or more

_TOP = ("format", "name", "about", "licence", "source", "anchors", "stations", "tags", "path", "floor")
_STATION = ("position_m", "rotation_wxyz", "wavelength_m", "antennas_m")
_TAG = ("height_m", "offset_m")


def read_rig(path: Path) -> tuple[Rig, tuple[str, ...]]:
    """The rig in a `rig.toml` and one notice for each key that is not known; raises UnusableInput."""
    try:
        content = tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except FileNotFoundError:
        raise UnusableInput(
            f"{path}: missing, expected beside the tables, with `format = {FORMAT}`, a name and the geometry; add it"
        ) from None
    except OSError as error:
        raise UnusableInput(f"{path}: cannot be read ({error.strerror}); check the file and its permissions") from error
    except UnicodeDecodeError as error:
        raise UnusableInput(f"{path}: is not UTF-8 text at byte {error.start}; save it as UTF-8") from error
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise UnusableInput(f"{path}: is not valid TOML: {error}; texts stand in quotes, lists in brackets") from error
    return _Reader(path).rig(content)


class _Reader:
    """Turns parsed TOML into geometry and collects the notices on the way."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notices: list[str] = []

    def rig(self, content: dict[str, Any]) -> tuple[Rig, tuple[str, ...]]:
        version = content.get("format")
        if version != FORMAT or isinstance(version, bool):
            found = "no `format`" if version is None else f"format = {version!r}"
            raise UnusableInput(f"{self.path}: {found}, expected `format = {FORMAT}`, the only one this program reads")
        self.known(content, _TOP, "the top level")
        words = {key: content.get(key, "") for key in ("name", "about", "licence", "source")}
        for key, word in words.items():
            if not isinstance(word, str):
                self.refuse(key, word, "a text in quotes")
        path = self.table(content, "path")
        self.known(path, ("knots_m",), "[path]")
        if "path" in content and "knots_m" not in path:
            raise UnusableInput(f"{self.path}: [path] has no knots_m, expected a list of [x, y] corners in metres")
        floor = self.table(content, "floor")
        self.known(floor, ("walls_m", "outline_m"), "[floor]")
        if "floor" in content and not floor.keys() & {"walls_m", "outline_m"}:
            raise UnusableInput(
                f"{self.path}: [floor] has neither walls_m nor outline_m, expected lists of [x1, y1, x2, y2] and of "
                "[x, y] corners in metres"
            )
        rig = Rig(
            name=words["name"] or self.path.resolve().parent.name,
            anchors={key: self.vector(f"anchors.{key}", v, 3) for key, v in self.table(content, "anchors").items()},
            stations={key: self.station(f"stations.{key}", v) for key, v in self.table(content, "stations").items()},
            tags={key: self.tag(f"tags.{key}", v) for key, v in self.table(content, "tags").items()},
            path_knots=self.knots(path["knots_m"]) if path else None,
            walls=self.points("floor.walls_m", floor["walls_m"], 4, 1) if "walls_m" in floor else None,
            outline=self.points("floor.outline_m", floor["outline_m"], 2, 3) if "outline_m" in floor else None,
            about=words["about"],
            licence=words["licence"],
            source=words["source"],
        )
        return rig, tuple(self.notices)

    def station(self, where: str, content: Any) -> Station:
        if not isinstance(content, dict):
            self.refuse(where, content, "a table [stations.ID]")
        self.known(content, _STATION, f"[{where}]")
        for key in ("position_m", "rotation_wxyz"):
            if key not in content:
                raise UnusableInput(f"{self.path}: [{where}] has no {key}, expected position_m and rotation_wxyz")
        rotation = self.vector(f"{where}.rotation_wxyz", content["rotation_wxyz"], 4)
        norm = float(np.linalg.norm(rotation))
        if abs(norm - 1) > NORM_TOLERANCE:
            raise UnusableInput(
                f"{self.path}: {where}.rotation_wxyz has length {norm:.4g}, expected a unit quaternion w, x, y, z "
                "(array frame to world frame); no rotation is [1, 0, 0, 0]"
            )
        antennas = wavelength = None
        if ("antennas_m" in content) != ("wavelength_m" in content):
            have, lack = ("antennas_m", "wavelength_m") if "antennas_m" in content else ("wavelength_m", "antennas_m")
            raise UnusableInput(f"{self.path}: [{where}] has {have} but no {lack}; a station with phases needs both")
        if "antennas_m" in content:
            antennas = self.points(f"{where}.antennas_m", content["antennas_m"])
            wavelength = self.number(f"{where}.wavelength_m", content["wavelength_m"])
            if wavelength <= 0:
                self.refuse(f"{where}.wavelength_m", wavelength, "a positive length in metres")
        position = self.vector(f"{where}.position_m", content["position_m"], 3)
        return Station(position=position, rotation=rotation / norm, antennas=antennas, wavelength=wavelength)

    def tag(self, where: str, content: Any) -> Tag:
        if not isinstance(content, dict):
            self.refuse(where, content, "a table [tags.ID]")
        self.known(content, _TAG, f"[{where}]")
        return Tag(
            height=self.number(f"{where}.height_m", content["height_m"]) if "height_m" in content else None,
            offset=self.vector(f"{where}.offset_m", content["offset_m"], 3) if "offset_m" in content else None,
        )

    def knots(self, value: Any) -> np.ndarray:
        knots = self.points("path.knots_m", value)
        try:
            Polyline(knots)
        except ValueError as problem:
            raise UnusableInput(f"{self.path}: path.knots_m: {problem}") from problem
        return knots

    def table(self, content: dict[str, Any], key: str) -> dict[str, Any]:
        value = content.get(key, {})
        if not isinstance(value, dict):
            self.refuse(key, value, f"a table [{key}]")
        return value

    def points(self, where: str, value: Any, size: int = 2, least: int = 2) -> np.ndarray:
        if not isinstance(value, list) or len(value) < least:
            counts, names = {1: "one", 2: "two", 3: "three"}, {2: "[x, y]", 4: "[x1, y1, x2, y2]"}
            self.refuse(where, value, f"a list of at least {counts[least]} {names[size]} in metres")
        return np.stack([self.vector(f"{where}[{i}]", point, size) for i, point in enumerate(value)])

    def vector(self, where: str, value: Any, size: int) -> np.ndarray:
        if not isinstance(value, list) or len(value) != size:
            self.refuse(where, value, f"a list of {size} numbers")
        return np.array([self.number(where, v) for v in value])

    def number(self, where: str, value: Any) -> float:
        try:
            if not isinstance(value, bool | str) and math.isfinite(value):
                return float(value)
        except (TypeError, OverflowError):
            pass
        self.refuse(where, value, "a finite number")

    def known(self, content: Iterable[str], expected: tuple[str, ...], where: str) -> None:
        """Refuses a key that looks like a misspelt one; any other that isn't expected gets a notice."""
        for key in content:
            if key in expected:
                continue
            near = difflib.get_close_matches(key.lower(), [e for e in expected if e not in content], 1, 0.7)
            if near:
                raise UnusableInput(f"{self.path}: unknown key {key!r} in {where}, expected {near[0]}; rename it")
            self.notices.append(f"{RIG_FILE}: key {key!r} in {where} is not part of the format and was ignored")

    def refuse(self, where: str, value: Any, expected: str) -> NoReturn:
        found = repr(value) if len(repr(value)) <= 60 else repr(value)[:57] + "..."
        raise UnusableInput(f"{self.path}: {where} = {found}, expected {expected}")


def rig_text(rig: Rig) -> str:
    """The content of the `rig.toml` that `read_rig` reads back to the same rig."""
    lines = [f"format = {FORMAT}", f"name = {_text(rig.name)}"]
    words = {"about": rig.about, "licence": rig.licence, "source": rig.source}
    lines += [f"{key} = {_text(word)}" for key, word in words.items() if word]
    if rig.anchors:
        lines += ["", "[anchors]", *(f"{_text(key)} = {_list(position)}" for key, position in rig.anchors.items())]
    for key, station in rig.stations.items():
        lines += ["", f"[stations.{_text(key)}]", f"position_m = {_list(station.position)}"]
        lines += [f"rotation_wxyz = {_list(station.rotation)}"]
        if station.antennas is not None and station.wavelength is not None:
            lines += [f"wavelength_m = {float(station.wavelength)!r}", f"antennas_m = {_list(station.antennas)}"]
    for key, tag in rig.tags.items():
        lines += ["", f"[tags.{_text(key)}]"]
        lines += [] if tag.height is None else [f"height_m = {float(tag.height)!r}"]
        lines += [] if tag.offset is None else [f"offset_m = {_list(tag.offset)}"]
    if rig.path_knots is not None:
        lines += ["", "[path]", f"knots_m = {_list(rig.path_knots)}"]
    if rig.walls is not None or rig.outline is not None:
        lines += ["", "[floor]"]
        lines += [] if rig.walls is None else [f"walls_m = {_list(rig.walls)}"]
        lines += [] if rig.outline is None else [f"outline_m = {_list(rig.outline)}"]
    return "\n".join(lines) + "\n"


def _text(value: str) -> str:
    """A TOML basic string: JSON's escapes are TOML's, but for the delete character, which TOML wants escaped."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _list(value: np.ndarray) -> str:
    return json.dumps(np.asarray(value, float).tolist())
