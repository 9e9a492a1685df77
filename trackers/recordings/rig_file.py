"""Reader and writer of `rig.toml`, the geometry of a recording; an invalid value is refused with its key."""

from __future__ import annotations

import difflib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from trackwright.trackers.core.errors import UnusableInput, has_control
from trackwright.trackers.core.model.rig import Point, Rig, Station, Tag, checked_knots
from trackwright.trackers.recordings.files import NUMBERS, Number, read_model

FORMAT = 1
RIG_FILE = "rig.toml"
HIGHEST = 1e5  # metres, of a tag
SHORTEST = 1e-6  # wavelength, m: of light
NORM_TOLERANCE = 1e-3  # for a quaternion written with three decimals

Vector = Annotated[Point, NUMBERS]
Quaternion = Annotated[Float[np.ndarray, " 4"], NUMBERS]
Points = Annotated[Float[np.ndarray, "n 2"], NUMBERS]
Walls = Annotated[Float[np.ndarray, "n 4"], NUMBERS]


class _Table(BaseModel):
    """A table of rig.toml; unknown keys are told, since files are written by hand."""

    model_config = ConfigDict(extra="allow", arbitrary_types_allowed=True)


def _unit(rotation: np.ndarray) -> np.ndarray:
    norm = float(np.linalg.norm(rotation))
    if abs(norm - 1) > NORM_TOLERANCE:
        frames = "w, x, y, z from array frame to world frame"
        raise ValueError(f"has length {norm:.4g}, expected a unit quaternion {frames}; no rotation is [1, 0, 0, 0]")
    return rotation / norm


class _Station(_Table):
    position_m: Vector
    rotation_wxyz: Annotated[Quaternion, AfterValidator(_unit)] | None = None
    yaw_deg: Number | None = None
    pitch_deg: Number | None = None
    roll_deg: Number | None = None
    wavelength_m: Annotated[Number, Field(ge=SHORTEST)] | None = None
    antennas_m: Annotated[Points, Field(min_length=2)] | None = None

    @model_validator(mode="after")
    def _complete(self) -> _Station:
        angles = [self.yaw_deg, self.pitch_deg, self.roll_deg]
        if self.rotation_wxyz is None and self.yaw_deg is None:
            raise ValueError("has no attitude, expected rotation_wxyz, or yaw_deg instead")
        if self.rotation_wxyz is not None and angles != [None, None, None]:
            raise ValueError("has rotation_wxyz and yaw_deg, pitch_deg or roll_deg, expected one of them")
        if (self.antennas_m is None) != (self.wavelength_m is None):
            raise ValueError("has one of antennas_m and wavelength_m; a station with phases needs both")
        return self

    def station(self) -> Station:
        angles = np.deg2rad([self.yaw_deg or 0.0, self.pitch_deg or 0.0, self.roll_deg or 0.0])
        rotation = mounted(*angles) if self.rotation_wxyz is None else self.rotation_wxyz
        return Station(self.position_m, rotation, self.antennas_m, self.wavelength_m)


class _Tag(_Table):
    height_m: Annotated[Number, Field(ge=-HIGHEST, le=HIGHEST)] | None = None
    offset_m: Vector | None = None


class _Body(_Table):
    tags: Annotated[list[str], Field(min_length=2)]


class _Path(_Table):
    knots_m: Annotated[Points, AfterValidator(checked_knots)]


class _Floor(_Table):
    walls_m: Annotated[Walls, Field(min_length=1)] | None = None
    outline_m: Annotated[Points, Field(min_length=3)] | None = None


def _plain(name: str) -> str:
    if has_control(name):
        raise ValueError(f"{name!r} has a control character; expected a name without")
    return name


_Name = Annotated[str, AfterValidator(_plain)]


class _RigFile(_Table):
    name: _Name = ""
    about: str = ""
    licence: str = ""
    source: str = ""
    anchors: dict[_Name, Vector] = {}
    stations: dict[_Name, _Station] = {}
    tags: dict[_Name, _Tag] = {}
    bodies: dict[_Name, _Body] = {}
    path: _Path | None = None
    floor: _Floor | None = None

    @model_validator(mode="after")
    def _consistent(self) -> _RigFile:
        carried = [tag for body in self.bodies.values() for tag in body.tags]
        for tag in carried:
            if tag not in self.tags or self.tags[tag].offset_m is None:
                raise ValueError(f"bodies: tag {tag!r} has no offset_m under [tags.{tag}]; add it")
            if carried.count(tag) > 1:
                raise ValueError(f"bodies: tag {tag!r} is named again; expected each tag on one body, once")
        return self


def read_rig(path: Path) -> tuple[Rig, tuple[str, ...]]:
    """The rig in a `rig.toml`, and a notice for each unknown key; raises UnusableInput."""
    if not os.path.lexists(path):
        raise UnusableInput(
            f"{path}: missing, expected `format = {FORMAT}`, a name, the geometry; add it, or give another folder"
        )
    file = read_model(path, _RigFile, f"the geometry of a recording, format = {FORMAT}", "correct it", FORMAT)
    tables: dict[str, _Table | None] = {"the top level": file, "[path]": file.path, "[floor]": file.floor}
    for kind in ("stations", "tags", "bodies"):
        tables |= {f"[{kind}.{name}]": table for name, table in getattr(file, kind).items()}
    notices = []
    for where, table in ((where, table) for where, table in tables.items() if table is not None):
        for key in table.model_extra or ():
            absent = [name for name in type(table).model_fields if name not in table.model_fields_set]
            if near := difflib.get_close_matches(key.lower(), absent, 1, 0.7):
                raise UnusableInput(f"{path}: unknown key {key!r} in {where}, expected {near[0]}; rename it")
            notices.append(f"{RIG_FILE}: key {key!r} in {where} is not part of the format and was ignored")
    rig = Rig(
        name=file.name or path.resolve().parent.name,
        anchors=file.anchors,
        stations={name: station.station() for name, station in file.stations.items()},
        tags={name: Tag(tag.height_m, tag.offset_m) for name, tag in file.tags.items()},
        bodies={name: tuple(body.tags) for name, body in file.bodies.items()},
        path_knots=file.path.knots_m if file.path else None,
        walls=file.floor.walls_m if file.floor else None,
        outline=file.floor.outline_m if file.floor else None,
        about=file.about,
        licence=file.licence,
        source=file.source,
    )
    return rig, tuple(notices)


def mounted(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """The quaternion w, x, y, z of a station: Rz(yaw) Ry(pitch) Rx(roll), rad, of x ahead, y left and z up."""
    from scipy.spatial.transform import Rotation

    # The array's x is left, y up and z ahead.
    turned = Rotation.from_euler("ZYX", [yaw, pitch, roll]) * Rotation.from_quat([0.5, 0.5, 0.5, 0.5])
    return np.roll(turned.as_quat(), 1)


def rig_text(rig: Rig) -> str:
    """The content of a `rig.toml` that `read_rig` reads back to the same rig; each vector is on one line."""
    texts = {key: getattr(rig, key) or None for key in ("about", "licence", "source")}
    tables: dict[str, Mapping[str, Any]] = {"": {"format": FORMAT, "name": rig.name} | texts}
    tables["anchors"] = {_text(name): place for name, place in rig.anchors.items()}
    for name, station in rig.stations.items():
        array = {"wavelength_m": station.wavelength, "antennas_m": station.antennas}
        pose = {"position_m": station.position, "rotation_wxyz": station.rotation}
        tables[f"stations.{_text(name)}"] = pose | array
    for name, tag in rig.tags.items():
        tables[f"tags.{_text(name)}"] = {"height_m": tag.height, "offset_m": tag.offset}
    tables |= {f"bodies.{_text(name)}": {"tags": names} for name, names in rig.bodies.items()}
    tables |= {"path": {"knots_m": rig.path_knots}, "floor": {"walls_m": rig.walls, "outline_m": rig.outline}}
    parts = []
    for name, values in tables.items():
        lines = [f"{key} = {_value(value)}\n" for key, value in values.items() if value is not None]
        if lines or name.startswith("tags."):
            parts.append(f"[{name}]\n" * bool(name) + "".join(lines))
    return "\n".join(parts)


def _value(value: Any) -> str:
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, tuple):
        return f"[{', '.join(map(_text, value))}]"
    return str(value) if isinstance(value, int) else json.dumps(np.asarray(value, float).tolist())


def _text(value: str) -> str:
    """A TOML basic string: as in JSON, except that TOML requires the delete character to be escaped."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
