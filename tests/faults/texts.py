"""Random faults in TOML, JSON and other files that are not tables."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.faults.values import CELLS, IDS, OF_BYTES, Draw, other_line, other_value, pick

TUNED = """tracker = "fix-kf"
objective = "nll"
before = 0.62
after = 0.42

[tunables."motion.sigma_a"]
value = 0.15
unit = "m/s^2/sqrt(Hz)"
standard_error = 0.002
lowest_95 = 0.14
highest_95 = 0.16

[tunables."sensors.*.sigma_*"]
value = 0.05
"""
CALIBRATION = """format = 1
recordings = ["walk-1", "walk-2"]
range_spread_m = 0.058

[stations.S1]
rows = 812
position_m = [0.0, 2.5, 2.3]
rotation_wxyz = [0.5, 0.5, 0.5, 0.5]

[stations.S1.azimuth]
offset_rad = 0.0473
gain = 1.0935
cubic_per_rad2 = -0.0634
cross_per_rad = 0.0831
lowest_rad = -0.6433
highest_rad = 0.6427
covariance = [[1e-4, 0.0, 0.0, 0.0], [0.0, 1e-4, 0.0, 0.0], [0.0, 0.0, 1e-4, 0.0], [0.0, 0.0, 0.0, 1e-4]]

[stations.S1.elevation]
offset_rad = 0.01
gain = 1.0
cubic_per_rad2 = 0.0
cross_per_rad = 0.0
lowest_rad = -0.6433
highest_rad = 0.6427
covariance = [[1e-4, 0.0, 0.0, 0.0], [0.0, 1e-4, 0.0, 0.0], [0.0, 0.0, 1e-4, 0.0], [0.0, 0.0, 0.0, 1e-4]]

[anchors.A1]
rows = 670
position_m = [0.0, 0.0, 0.3]
bias_m = -0.0391
slope = -0.0083
lowest_m = 1.36
highest_m = 7.02
covariance = [[1e-4, 0.0], [0.0, 1e-4]]

[tags.T1]
rows = 1340
bias_m = 0.0314
standard_error_m = 0.0061
"""
STUDY = """name = "small"
about = "Which is better?"
runs = 2
seed = 3
metrics = ["rmse_m", "nees_mean"]

[worlds.line]
rate_hz = 1.0
speed = 0.3

[worlds.other]
kind = "station"
rows = 5

[trackers.fix-kf]
tunables = {"motion.sigma_a" = 0.2}
every = 0.5

[trackers.window]
tracker = "moving-average"

[grid]
"world.speed" = [0.2, 0.3]
"motion.sigma_a,sensors.*.sigma_*" = [0.1]
"""
MAPPING = """[[tables]]
table = "ranges"
columns = {t_s = "time*0.001", tag = "'T1'", anchor = "who", range_m = "distance in mm"}
"""
POINTS = "name,x_m,y_m,z_m\nP1,1.0,2.0,0.5\nP2,2.0,2.0,0.5\nP3,2.5,2.0,0.5\n"


def broken_toml(draw: Draw, text: str) -> bytes:
    """A TOML file with one to three faults in its values, keys, lines or bytes."""
    for _ in range(int(draw.integers(1, 4))):
        text = pick(draw, (_value, _value, other_line, _key))(draw, text)
    data = text.encode("utf-8", "surrogatepass")
    return pick(draw, OF_BYTES)(draw, data) if draw.random() < 0.2 else data


def broken_file(draw: Draw, path: Path) -> str:
    """Damages a file: its JSON where it is JSON, its cells where it is CSV, else its bytes; what was done, in words."""
    ways: list[Callable[[Draw, bytes], bytes]] = [
        *OF_BYTES,
        lambda draw, data: b"",
        lambda draw, data: draw.bytes(len(data)),
    ]
    if path.suffix == ".json":
        ways += [_of_json] * 2 * len(ways)
    elif path.suffix in (".csv", ".txt"):
        ways += [_of_cells] * 2 * len(ways)
    way = pick(draw, ways)
    path.write_bytes(way(draw, path.read_bytes()))
    return f"{getattr(way, '__name__', '').strip('_')} of {path.name}"


def _value(draw: Draw, text: str) -> str:
    return other_value(draw, text, r"(?<= = ).*$|-?\d+(\.\d+|e-\d+)")


def _key(draw: Draw, text: str) -> str:
    old = pick(draw, sorted(set(re.findall(r"[A-Za-z_]\w+", text))) or ["x"])
    return re.sub(rf"\b{old}\b", lambda _: json.dumps(pick(draw, (*IDS, "x", "format", "*"))), text, count=1)


def _of_json(draw: Draw, data: bytes) -> bytes:
    content = json.loads(data)
    places: list[tuple[Any, Any]] = []
    waiting = [content]
    while waiting:
        one = waiting.pop()
        items = one.items() if isinstance(one, dict) else enumerate(one)
        for key, value in items:
            places.append((one, key))
            if isinstance(value, (dict, list)):
                waiting.append(value)
    inside, key = pick(draw, places)
    value = pick(draw, (None, [], {}, "", "x", -1, 1e308, True, [[]], {"a": {}}, "gone", 10**30))
    if value == "gone":
        del inside[key]
    else:
        inside[key] = value
    return json.dumps(content).encode()


def _of_cells(draw: Draw, data: bytes) -> bytes:
    lines = data.decode().split("\n")
    k = int(draw.integers(len(lines)))
    cells = lines[k].split(",")
    cells[int(draw.integers(len(cells)))] = pick(draw, CELLS)
    lines[k] = ",".join(cells)
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def damage(seed: int, number: int) -> np.random.Generator:
    """The random numbers of a case."""
    return np.random.default_rng([seed, number, 2])
