"""A small valid recording for tests, and builders that write it to a new folder with one fault.

A builder returns a word expected in the message about its fault.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import polars as pl

from trackwright.trackers.core.model.rig import Station

Builder = Callable[[Path], str]

RIG = """format = 1
name = "good"
about = "Made for tests."

[anchors]
"A1" = [0.0, 0.0, 0.3]
"A2" = [6.0, 0.0, 2.6]
"A3" = [6.0, 5.0, 0.4]
"A4" = [0.0, 5.0, 2.9]

[stations.S1]
position_m = [0.0, 2.5, 2.3]
rotation_wxyz = [0.5, 0.5, 0.5, 0.5]
wavelength_m = 0.0125
antennas_m = [[0.02, 0.0], [0.0, 0.01], [-0.02, 0.0], [0.0, -0.01]]

[stations.S2]
position_m = [6.0, 2.5, 2.3]
rotation_wxyz = [0.5, 0.5, -0.5, -0.5]
wavelength_m = 0.0125
antennas_m = [[0.02, 0.0], [0.0, 0.01], [-0.02, 0.0], [0.0, -0.01]]

[tags.T1]
height_m = 1.0

[tags.T2]
offset_m = [0.1, 0.0, 0.0]

[path]
knots_m = [[1.0, 1.0], [5.0, 1.0], [5.0, 4.0]]
"""
_ANCHORS = {"A1": (0.0, 0.0, 0.3), "A2": (6.0, 0.0, 2.6), "A3": (6.0, 5.0, 0.4), "A4": (0.0, 5.0, 2.9)}
_ANTENNAS, _WAVELENGTH = np.array([[0.02, 0.0], [0.0, 0.01], [-0.02, 0.0], [0.0, -0.01]]), 0.0125
_STATIONS = {
    "S1": Station(np.array([0.0, 2.5, 2.3]), np.array([0.5, 0.5, 0.5, 0.5]), _ANTENNAS, _WAVELENGTH),
    "S2": Station(np.array([6.0, 2.5, 2.3]), np.array([0.5, 0.5, -0.5, -0.5]), _ANTENNAS, _WAVELENGTH),
}


@cache
def good_tables() -> dict[str, pl.DataFrame]:
    """Five seconds of two tags at 10 Hz in every table; values are smooth, and but for the IMU physical."""
    rng = np.random.default_rng(3)
    rows: dict[str, list[dict]] = {name: [] for name in ("ranges", "fixes", "bearings", "phases", "imu", "truth")}
    for t in np.round(np.arange(50) * 0.1, 3):
        for tag, shift in (("T1", 0.0), ("T2", 1.0)):
            position = np.array([2 + shift + np.cos(t), 2 + np.sin(t), 1.0])
            head = {"t_s": float(t), "tag": tag}
            axes = dict(zip(("x_m", "y_m", "z_m"), position, strict=True))
            rows["truth"].append(head | axes | {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0})
            rows["fixes"].append(head | {k: v + rng.normal(0, 0.03) for k, v in axes.items()} | {"x_std_m": 0.03})
            accel = dict(zip("xyz", rng.normal((0, 0, 9.81), 0.05), strict=True))
            gyro = dict(zip("xyz", rng.normal(0, 0.01, 3), strict=True))
            imu = {f"accel_{k}_mps2": v for k, v in accel.items()} | {f"gyro_{k}_radps": v for k, v in gyro.items()}
            rows["imu"].append(head | imu)
            for anchor, at in _ANCHORS.items():
                distance = float(np.linalg.norm(position - at)) + rng.normal(0, 0.03)
                rows["ranges"].append(head | {"anchor": anchor, "range_m": distance, "range_std_m": 0.03})
            for station in ("S1", "S2"):
                azimuth, elevation = (float(x) for x in _STATIONS[station].angles(position))
                angles = {"azimuth_rad": azimuth, "elevation_rad": elevation + rng.normal(0, 0.01)}
                rows["bearings"].append(head | {"station": station} | angles)
                paths = np.linalg.norm(position - _STATIONS[station].antenna_positions(), axis=1)
                turned = rng.uniform(-0.3, 0.3, 4) - 2 * np.pi / _WAVELENGTH * paths
                phases = {f"phase_{k + 1}_rad": x for k, x in enumerate(np.angle(np.exp(1j * turned)).tolist())}
                rows["phases"].append(head | {"station": station} | phases)
    return {name: pl.DataFrame(table) for name, table in rows.items()}


def write_good(folder: Path) -> None:
    """Write the valid recording as plain CSV, without the code under test."""
    folder.mkdir(parents=True)
    (folder / "rig.toml").write_text(RIG)
    for name, table in good_tables().items():
        table.write_csv(folder / f"{name}.csv")


def with_rig(old: str, new: str, word: str = "rig.toml") -> Builder:
    """The valid recording with a part of its rig.toml replaced."""

    def build(folder: Path) -> str:
        write_good(folder)
        assert old in RIG
        (folder / "rig.toml").write_text(RIG.replace(old, new, 1))
        return word

    return build


def with_file(name: str, content: Callable[[bytes], bytes] | bytes, to: str = "") -> Builder:
    """The valid recording with the bytes of one file replaced, renamed to `to` if given."""

    def build(folder: Path) -> str:
        write_good(folder)
        old = (folder / name).read_bytes()
        (folder / name).unlink()
        (folder / (to or name)).write_bytes(content if isinstance(content, bytes) else content(old))
        return to or name

    return build


def with_cell(table: str, column: str, text: str, row: int = 7) -> Builder:
    """The valid recording with one cell replaced; the message must name its line."""

    def build(folder: Path) -> str:
        write_good(folder)
        lines = (folder / f"{table}.csv").read_text().splitlines()
        cells = lines[row].split(",")
        cells[lines[0].split(",").index(column)] = text
        lines[row] = ",".join(cells)
        (folder / f"{table}.csv").write_text("\n".join(lines) + "\n")
        return f"{table}.csv: row {row} (line {row + 1}), column {column}"

    return build


def with_line(table: str, change: Callable[[str], str], row: int, word: str = "") -> Builder:
    """The valid recording with one line of a table changed; line 0 is the header."""

    def build(folder: Path) -> str:
        write_good(folder)
        lines = (folder / f"{table}.csv").read_text().splitlines()
        lines[row] = change(lines[row])
        (folder / f"{table}.csv").write_text("\n".join(lines) + "\n")
        return word or f"{table}.csv"

    return build


def with_renamed(table: str, old: str, new: str) -> Builder:
    return with_line(table, lambda line: line.replace(old, new), 0)


def with_table(name: str, change: Callable[[pl.DataFrame], pl.DataFrame], kind: str = "csv", word: str = "") -> Builder:
    """The valid recording with one table changed as a frame."""

    def build(folder: Path) -> str:
        write_good(folder)
        changed = change(good_tables()[name])
        (folder / f"{name}.csv").unlink()
        if kind == "parquet":
            changed.write_parquet(folder / f"{name}.parquet")
        else:
            changed.write_csv(folder / f"{name}.csv")
        return word or f"{name}.{kind}"

    return build


def then(change: Callable[[Path], str]) -> Builder:
    """The valid recording, then `change` applied to its folder."""

    def build(folder: Path) -> str:
        write_good(folder)
        return change(folder)

    return build


def with_directory(name: str) -> Builder:
    def build(folder: Path) -> str:
        write_good(folder)
        (folder / name).unlink()
        (folder / name).mkdir()
        return name

    return build


def with_parquet(name: str, change: Callable[[bytes], bytes]) -> Builder:
    """The valid recording with the bytes of a Parquet table damaged."""

    def build(folder: Path) -> str:
        write_good(folder)
        file = folder / f"{name}.parquet"
        good_tables()[name].write_parquet(file)
        (folder / f"{name}.csv").unlink()
        file.write_bytes(change(file.read_bytes()))
        return file.name

    return build
