"""Files of other programs with one fault, for `import`: tables, trajectories, logs of kits, bags."""

from __future__ import annotations

import atexit
import os
import re
import shutil
import tempfile
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from tests.bags import RANGE, UWB, write_bag
from tests.faults.values import CELLS, OF_BYTES, Draw, other_line, pick
from tests.faulty import RIG

LOG = (
    "0.1 1151[5.00,8.00,2.25]=6.48 0CA8[0.00,8.00,2.25]=6.51 le_us=2576 est[2.57,1.98,1.68,100]\n"
    "0.2 DIST,2,AN0,1151,5.00,8.00,2.25,6.44,AN1,0CA8,0.00,8.00,2.25,6.50,POS,2.55,2.01,1.71,98\n"
    "0.3 POS,2.57,2.00,1.67,97\n"
)
TREK = "mc 0f 00000663 000005a3 00000512 000004cb 095f c1 00024c24 a0:0\n" * 3
TUM = "".join(f"{k * 0.1} {k} 2.0 0.5 0.0 0.0 0.6 0.8\n" for k in range(6))
EUROC = "#timestamp [ns], p_RS_R_x [m]\n" + "".join(f"{k}00000000,{k},2.0,0.5,0.8,0,0,0.6\n" for k in range(6))
CSV = "time,who,distance\n1000,A1,2000\n1100,A2,3000\n1200,A1,2100\n"

_ANCHORS = "".join(f'"{name}" = [{name}.0, {k}.0, 2.0]\n' for k, name in enumerate(("17", "42", "0", "1", "2", "3")))
_POSES = ("--table", "truth", "--tag", "T1")
_UWB = ("t_s=header.stamp", "tag=tag", "anchor=ranges[].anchor", "range_m=ranges[].distance_mm in mm")
_BAG = ("--table", "ranges", "--topic", "/uwb", "--columns", *_UWB)
_CSV = ("--table", "ranges", "--columns", "t_s=time in ms", "anchor=who", "range_m=distance in mm", "--tag", "T1")
KINDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "csv": ("log.csv", _CSV),
    "semicolons": ("log.csv", (*_CSV, "--separator", ";")),
    "dwm1001": ("log.txt", ("--tag", "T1")),
    "trek1000": ("log.txt", ("--tag", "T1")),
    "tum": ("path.tum", _POSES),
    "euroc": ("path.csv", _POSES),
}
BAGS: dict[str, tuple[str, tuple[str, ...]]] = {
    "bag": ("old.bag", _BAG),
    "mcap": ("new/new.mcap", _BAG),
    "metadata": ("new/metadata.yaml", _BAG),
    "db3": ("sql/sql.db3", _BAG),
    "msg": ("uwb_msgs/msg/Ranges.msg", _BAG),
}
"""By kind: the file that is damaged, and the words after `import SOURCE`."""
_TEXTS = {"csv": CSV, "semicolons": CSV.replace(",", ";"), "dwm1001": LOG, "trek1000": TREK, "tum": TUM, "euroc": EUROC}


@cache
def _bags() -> Path:
    """A folder with a bag of ROS 1, bags of ROS 2 as MCAP and SQLite, and message definitions."""
    folder = Path(tempfile.mkdtemp(prefix="bags-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for name, kind in (("old.bag", "bag"), ("new", "mcap"), ("sql", "db3")):
        write_bag(folder / name, kind)
    (folder / "uwb_msgs" / "msg").mkdir(parents=True)
    for name, text in (("Range", RANGE), ("Ranges", UWB)):
        (folder / "uwb_msgs" / "msg" / f"{name}.msg").write_text(text)
    return folder


def broken_source(draw: Draw, place: Path) -> tuple[str, tuple[str | Path, ...]]:
    """Writes a source with one fault and a rig into a folder; its fault in words, and those of `import`."""
    kinds = {**KINDS, **BAGS} if find_spec("rosbags") else KINDS
    kind = pick(draw, [*kinds])
    name, words = kinds[kind]
    if kind in BAGS:
        shutil.copytree(_bags(), place, dirs_exist_ok=True)
    else:
        (place / name).write_text(_TEXTS[kind])
    rig = place / "rig.toml"
    rig.write_text(RIG.replace('"A1" =', f'{_ANCHORS}"A1" ='))
    fault = _damaged(draw, place / name, kind in _TEXTS)
    source = place / {"metadata": "new", "db3": "sql", "msg": "sql"}.get(kind, name)
    definitions = [place / "uwb_msgs" / "msg" / f"{name}.msg" for name in ("Range", "Ranges")]
    # A log of a DWM1001 has the positions of its anchors.
    geometry = () if kind == "dwm1001" else ("--rig", rig)
    more = ("--messages", *definitions) if kind == "msg" else ()
    return f"{fault} of {kind}", ("import", source, *words, *geometry, *more)


def _damaged(draw: Draw, path: Path, is_text: bool) -> str:
    data = path.read_bytes()
    if draw.random() < 0.1:
        target = pick(draw, ("itself", "nothing", "/dev/zero", "pipe", "a folder"))
        path.unlink()
        if target == "pipe":
            os.mkfifo(path)
        else:
            places = {"itself": path, "nothing": path.parent / "gone", "a folder": path.parent}
            path.symlink_to(places.get(target, target))
        return f"link to {target}"
    if is_text and draw.random() < 0.6:
        text = data.decode()
        way = pick(draw, (_cell, other_line))
        path.write_bytes(way(draw, text).encode("utf-8", "surrogatepass"))
        return way.__name__.strip("_")
    way = pick(draw, OF_BYTES)
    path.write_bytes(way(draw, data))
    return way.__name__.strip("_")


def _cell(draw: Draw, text: str) -> str:
    """The text with another value in place of one of its words."""
    words = re.split(r"([,;\s=\[\]])", text)
    words[2 * int(draw.integers((len(words) + 1) // 2))] = pick(draw, CELLS)
    return "".join(words)
