"""Pages that begin with bags, done: their bags, of a simulated cart, then each of their commands, and the times."""

from __future__ import annotations

import re
import shlex
import shutil
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table
from trackwright.experiments.lab.subprocesses import REPOSITORY, command
from trackwright.experiments.lab.validation.surveys import simulated_site
from trackwright.sim.worlds import ranges as simulated_ranges
from trackwright.trackers.exchange.ros_reader import rosbags_module

OUT = Path("out/bag-tour")
PAGE, SURVEY_PAGE = (REPOSITORY / "docs" / name for name in ("ten-minutes.md", "survey.md"))
START = 1_770_000_000
TYPES = {
    "uwb_msgs/msg/Range": "string anchor\nuint32 distance_mm\n",
    "uwb_msgs/msg/Ranges": "std_msgs/Header header\nuwb_msgs/Range[] ranges\n",
}
DRIVES = {"drive-1": 11, "drive-2": 12}
"""Seeds of the drives."""

SITE, DRIVEN, SECONDS = 5, {"low": 0.5, "high": 1.9, "work": 1.2}, 270.0
"""Seed of the site without positions of anchors, the heights of the tag, m, in its drives, and their duration, s."""


def bag_tour(*, bags_only: bool = False, output: Output = DEFAULTS) -> int:
    """The ten-minute page, done: bags, files and results in out/bag-tour, and the times of its commands.

    Args:
        bags_only: write the bags and the files of the page alone, to follow the page by hand.
    """
    worlds = {
        name: simulated_ranges(n=1, seed=seed, rows=600, sigma_r=0.12, bias=0.05, hidden=0.15, lost=0.05).folder()
        for name, seed in DRIVES.items()
    }
    return _toured("bag-tour", PAGE, {name: world.tables for name, world in worlds.items()}, bags_only, output)


def survey_tour(*, bags_only: bool = False, output: Output = DEFAULTS) -> int:
    """From bags without positions of anchors to a rig, done as docs/survey.md says, as `bag_tour`.

    Args:
        bags_only: write the bags and the files of the page alone, to follow the page by hand.
    """
    drives = zip(DRIVEN, simulated_site(SITE, tuple(DRIVEN.values()), 0.0, SECONDS)[0], strict=True)
    return _toured("survey-tour", SURVEY_PAGE, {name: drive.tables for name, drive in drives}, bags_only, output)


def _toured(name: str, of_page: Path, drives: Mapping[str, Any], bags_only: bool, output: Output) -> int:
    """Bags of drives by their names, and the commands of a page."""
    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir(parents=True)
    for drive, tables in drives.items():
        write_bag(OUT / f"{drive}.mcap", tables)
    page = of_page.read_text(encoding="utf-8")
    for block in _blocks(page, "toml"):
        (OUT / block.split()[1]).write_text(block, encoding="utf-8")
    print(f"wrote {', '.join(str(path) for path in sorted(OUT.iterdir()))}")
    if bags_only:
        return 0
    rows, began = list[Row](), time.monotonic()
    for line in commands_of(page):
        begin = time.monotonic()
        command(*line[1:], folder=OUT)
        rows.append({"command": f"`{shlex.join(line[:3])}`", "s": time.monotonic() - begin})
    output.publish(f"validation {name}", Table(rows, note=f"All: {time.monotonic() - began:.0f} s."))
    return 0


def _blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page, re.DOTALL | re.MULTILINE)


def commands_of(page: str) -> list[list[str]]:
    """The commands of the page, as words, in their order."""
    lines = "\n".join(_blocks(page, "sh")).replace("\\\n", " ").splitlines()
    return [shlex.split(line) for line in lines if line.startswith("trackwright")]


def write_bag(path: Path, tables: Any) -> None:
    """Writes an MCAP file: /uwb with the table ranges in mm, /mocap/cart with the poses of truth, if there is any."""
    rosbag2, typesys = rosbags_module("rosbag2", str(path)), rosbags_module("typesys", str(path))
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for name, text in TYPES.items():
        store.register(typesys.get_types_from_msg(text, name))
    scratch = path.with_suffix("")
    with rosbag2.Writer(scratch, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        topics = {"/uwb": "uwb_msgs/msg/Ranges"}
        if "truth" in tables:
            topics["/mocap/cart"] = "geometry_msgs/msg/PoseStamped"
        connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in topics.items()}
        for topic, stamp, message in _messages(store.types, tables):
            writer.write(connections[topic], stamp, store.serialize_cdr(message, topics[topic]))
    (scratch / f"{scratch.name}.mcap").rename(path)
    shutil.rmtree(scratch)


def _messages(types: Any, tables: Any) -> Iterator[tuple[str, int, Any]]:
    """Topic, time in ns and message of the ranges and of the truth, on the clock of a robot."""
    point, turn = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    pose, stamped = types["geometry_msgs/msg/Pose"], types["geometry_msgs/msg/PoseStamped"]
    one, several = types["uwb_msgs/msg/Range"], types["uwb_msgs/msg/Ranges"]

    def header(seconds: float) -> tuple[int, Any]:
        stamp = START * 10**9 + round(seconds * 1e9)
        moment = types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
        return stamp, types["std_msgs/msg/Header"](moment, "hall")

    seen = tables["ranges"].drop_nulls("range_m").filter(pl.col("range_m") > 0)
    for (seconds,), rows in seen.partition_by("t_s", as_dict=True, maintain_order=True).items():
        stamp, head = header(seconds)
        messages = [one(str(r["anchor"]), round(1000 * r["range_m"])) for r in rows.iter_rows(named=True)]
        yield "/uwb", stamp, several(head, messages)
    for row in tables["truth"].iter_rows(named=True) if "truth" in tables else ():
        stamp, head = header(row["t_s"])
        place = np.nan_to_num([row["x_m"], row["y_m"], row["z_m"]]).tolist()
        yield "/mocap/cart", stamp, stamped(head, pose(point(*place), turn))
