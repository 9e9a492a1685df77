"""`calibration.toml`: systematic errors of stations and anchors, written by `calibrate`, read by `--calibration`."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import tomli_w

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.calibration import (
    ANGLES,
    AnchorCalibration,
    Calibration,
    StationCalibration,
    TagCalibration,
)
from trackwright.trackers.recordings.input_file import read_toml
from trackwright.trackers.recordings.rig_file import LARGEST

FORMAT = 1
COMMENT = "# Written by `trackwright calibrate`; read by `--calibration` of `track` and `tune`.\n"

_TOP = ("format", "recordings", "stations", "anchors", "tags")
_SPREAD = "range_spread_m"
_ANGLE_TERMS = ("offset_rad", "gain", "cubic_per_rad2", "cross_per_rad")
_ANGLE = (*_ANGLE_TERMS, "lowest_rad", "highest_rad", "covariance")
_STATION, _MOUNTED = ("rows", *ANGLES), ("position_m", "rotation_wxyz")
_RANGE_TERMS = ("bias_m", "slope")
_ANCHOR = ("rows", *_RANGE_TERMS, "lowest_m", "highest_m", "covariance")
_TAG = ("rows", "bias_m", "standard_error_m")


def write_calibration(calibration: Calibration, path: str | Path) -> Path:
    """Writes the calibration to the file `path`, completely or not at all; raises UnusableInput where it cannot be."""
    stations = {
        name: {"rows": one.rows}
        | ({} if one.mounted is None else _mounting(one.mounted))
        | {
            angle: _entries(_ANGLE, one.coefficients[k], one.spans[k], one.covariances[k])
            for k, angle in enumerate(ANGLES)
        }
        for name, one in calibration.stations.items()
    }
    anchors = {
        name: {"rows": one.rows}
        | ({} if one.position is None else {"position_m": np.asarray(one.position, float).tolist()})
        | _entries(_ANCHOR[1:], one.coefficients, one.span, one.covariance)
        for name, one in calibration.anchors.items()
    }
    content = {
        "format": FORMAT,
        "recordings": list(calibration.recordings),
        **({} if calibration.range_spread is None else {_SPREAD: calibration.range_spread}),
        "stations": stations,
        "anchors": anchors,
        "tags": {
            name: dict(zip(_TAG, (one.rows, one.bias, one.sigma), strict=True))
            for name, one in calibration.tags.items()
        },
    }
    text = COMMENT + tomli_w.dumps(content)
    return atomic_write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def _mounting(station: Station) -> dict[str, list[float]]:
    values = (np.asarray(value, float).tolist() for value in (station.position, station.rotation))
    return dict(zip(_MOUNTED, values, strict=True))


def _entries(names: Sequence[str], terms: np.ndarray, span: np.ndarray, covariance: np.ndarray) -> dict[str, Any]:
    return dict(zip(names, [*terms.tolist(), *span.tolist(), covariance.tolist()], strict=True))


def read_calibration(path: str | Path) -> Calibration:
    """The calibration in a `calibration.toml`; raises UnusableInput for content that `calibrate` does not write."""
    path = Path(path)
    return _Reader(path).calibration(read_toml(path, "the calibration.toml of `trackwright calibrate`"))


def identity(path: Path) -> dict[str, str]:
    """Name and fingerprint of a calibration file: what tells it from others."""
    return {"name": path.name, "fingerprint": hashlib.sha256(path.read_bytes()).hexdigest()[:16]}


class _Reader:
    """Converts parsed TOML into a `Calibration`; the path is for messages."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def calibration(self, content: dict[str, Any]) -> Calibration:
        version = content.get("format")
        if version != FORMAT or isinstance(version, bool):
            found = "no `format`" if version is None else f"format = {version!r}"
            self.refuse(f"{found}, expected `format = {FORMAT}` of the calibration.toml of `trackwright calibrate`")
        spread = (_SPREAD,) if _SPREAD in content else ()
        self.exactly(content, (*_TOP, *spread), "the top level")
        names = content["recordings"]
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            self.refuse(f"recordings = {names!r}, expected a list of names")
        stations, anchors, tags = (self.table(content[key], key) for key in ("stations", "anchors", "tags"))
        if not stations and not anchors:
            self.refuse("neither a station nor an anchor, expected [stations.ID] or [anchors.ID]")
        return Calibration(
            {name: self.station(f"stations.{name}", one) for name, one in stations.items()},
            {name: self.anchor(f"anchors.{name}", one) for name, one in anchors.items()},
            {name: self.tag(f"tags.{name}", one) for name, one in tags.items()},
            tuple(names),
            self.positive(_SPREAD, content[_SPREAD]) if spread else None,
        )

    def station(self, where: str, content: Any) -> StationCalibration:
        mounted = _MOUNTED if any(key in self.table(content, where) for key in _MOUNTED) else ()
        self.exactly(content, (*_STATION, *mounted), f"[{where}]")
        parts = []
        for angle in ANGLES:
            table = self.table(content[angle], f"{where}.{angle}")
            self.exactly(table, _ANGLE, f"[{where}.{angle}]")
            span = "lowest_rad", "highest_rad"
            parts.append(self.terms(f"{where}.{angle}", table, _ANGLE_TERMS, span))
        terms, spans, covariances = (np.stack(x) for x in zip(*parts, strict=True))
        station = None
        if mounted:
            position, rotation = (
                self.array(f"{where}.{key}", content[key], (size,)) for key, size in zip(mounted, (3, 4), strict=True)
            )
            station = Station(position, rotation)
        return StationCalibration(terms, covariances, spans, self.rows(where, content["rows"]), station)

    def anchor(self, where: str, content: Any) -> AnchorCalibration:
        placed = ("position_m",) if "position_m" in self.table(content, where) else ()
        self.exactly(content, (*_ANCHOR, *placed), f"[{where}]")
        terms, span, covariance = self.terms(where, content, _RANGE_TERMS, ("lowest_m", "highest_m"))
        if terms[1] <= -1.0:
            self.refuse(f"{where}.slope = {terms[1]:.6g}, expected a number above -1")
        position = self.array(f"{where}.position_m", content["position_m"], (3,)) if placed else None
        return AnchorCalibration(terms, covariance, span, self.rows(where, content["rows"]), position)

    def tag(self, where: str, content: Any) -> TagCalibration:
        self.exactly(self.table(content, where), _TAG, f"[{where}]")
        bias, sigma = (float(self.array(f"{where}.{key}", content[key], ())) for key in _TAG[1:])
        if sigma < 0.0:
            self.refuse(f"{where}.standard_error_m = {sigma:.6g}, expected a number of zero or more")
        return TagCalibration(bias, sigma, self.rows(where, content["rows"]))

    def terms(
        self, where: str, table: dict[str, Any], names: Sequence[str], ends: tuple[str, str]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The terms, their span and their covariance."""
        terms, span = (np.array([self.array(f"{where}.{name}", table[name], ()) for name in n]) for n in (names, ends))
        if span[0] > span[1]:
            self.refuse(f"{where}.{ends[0]} = {span[0]:.6g} is above {ends[1]} = {span[1]:.6g}, expected it below")
        covariance = self.array(f"{where}.covariance", table["covariance"], (len(names), len(names)))
        symmetric = np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-12)
        if not symmetric or np.linalg.eigvalsh(covariance)[0] < -1e-9 * np.trace(covariance):
            self.refuse(f"{where}.covariance is no covariance, expected a symmetric, positive semidefinite matrix")
        return terms, span, covariance

    def array(self, where: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
        try:
            found = np.asarray(value)
        except ValueError:
            found = np.array(None)
        numeric = found.dtype.kind in "if" and found.shape == shape
        numbers = found.astype(float) if numeric else np.array(np.nan)
        if not (np.abs(numbers) <= LARGEST).all():
            size = f"{' × '.join(map(str, shape))} finite numbers" if shape else "a finite number"
            shown = repr(value) if len(repr(value)) <= 60 else repr(value)[:57] + "..."
            self.refuse(f"{where} = {shown}, expected {size}, at most {LARGEST:g} in size")
        return numbers

    def positive(self, where: str, value: Any) -> float:
        found = float(self.array(where, value, ()))
        if found <= 0.0:
            self.refuse(f"{where} = {found:.6g}, expected a number above zero")
        return found

    def rows(self, where: str, value: Any) -> int:
        if not isinstance(value, int) or isinstance(value, bool) or value < 0:
            self.refuse(f"{where}.rows = {value!r}, expected a count")
        return value

    def table(self, value: Any, where: str) -> dict[str, Any]:
        if not isinstance(value, dict):
            self.refuse(f"{where} = {value!r}, expected a table [{where}]")
        return value

    def exactly(self, content: Mapping[str, Any], expected: tuple[str, ...], where: str) -> None:
        unknown = [key for key in content if key not in expected]
        lacking = [key for key in expected if key not in content]
        if unknown or lacking:
            found = f"unknown key {unknown[0]!r}" if unknown else f"no {lacking[0]}"
            self.refuse(f"{where} has {found}, expected {listed(expected, len(expected))}")

    def refuse(self, what: str) -> NoReturn:
        raise UnusableInput(f"{self.path}: {what}; write it with `trackwright calibrate`")
