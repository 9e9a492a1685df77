"""Kinds of measurement and importers with one fault each fail the check of that fault, and sound ones pass."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from tests.catalogue import RIG
from trackwright.trackers.recordings.kinds import KINDS


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
def test_the_kinds_of_the_library_keep_the_contract(kind):
    tw.check_kind(kind, RIG)


def _lengths(positions, sensors):
    first, second = sensors.distances(positions).T
    return (first + second)[:, None]


def _kind(predicted=_lengths, positive=False, **facts):
    column = tw.Column("path_m", 0.5, 0.5, 0.05, positive=positive)
    return tw.Kind("bistatic", (column,), ("anchor", "anchor_2"), predicted, **facts)


KIND_FAULTS = {
    "values": (_kind(lambda p, s: np.sqrt(1.0 - _lengths(p, s))), "predicted gives nan at .* usual fix: np.maximum"),
    "order": (_kind(lambda p, s: _lengths(p, s) - _lengths(p, s).mean()), "half of the rows in another order are off"),
    "moved site": (_kind(lambda p, s: _lengths(p, s) + p[:, :1]), "of the site moved as a whole are off"),
}


@pytest.mark.parametrize("name", KIND_FAULTS)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_fault_of_a_kind_is_named_by_its_check(name):
    kind, message = KIND_FAULTS[name]
    with pytest.raises(tw.BrokenContract, match=f"^{name.partition(':')[0]}: .*{message}"):
        tw.check_kind(kind, RIG)


@pytest.fixture
def log(tmp_path):
    """A log of one tag's ranges, `seconds anchor metres`, on a circle."""
    path = tmp_path / "my.log"
    lines = []
    for k in range(80):
        name = sorted(RIG.anchors)[k % 4]
        place = np.array([2 + np.sin(k / 20), 2 + np.cos(k / 20), 1.0])
        lines.append(f"{k / 10} {name} {np.linalg.norm(place - RIG.anchors[name]):.3f}\n")
    path.write_text("".join(lines), encoding="utf-8")
    return path


def _ranges(path, split=str.splitlines):
    rows = [line.split(" ") for line in split(path.read_bytes().decode())]
    return {"ranges": pl.DataFrame([r for r in rows if len(r) == 3], ["t_s", "anchor", "range_m"], orient="row")}


def _strict(path):
    lines = path.read_text().splitlines()
    assert lines[0], "no line"
    return _ranges(path)


def _in_milliseconds(path):
    return {"ranges": _ranges(path)["ranges"].with_columns(pl.col("range_m").cast(float) * 1000)}


ONE = pl.DataFrame({"t_s": [0.0], "anchor": [min(RIG.anchors)], "range_m": [1.0]})

IMPORTER_FAULTS = {
    "empty log": (_strict, "IndexError: "),
    "recording": (_in_milliseconds, "`check` of what _in_milliseconds gives says: "),
    "empty log: rows": (lambda path: {"ranges": ONE}, "gives rows of an empty log"),
    "recording: tables": (lambda path: [1, 2], "gives list of my.log, expected frames by the names of tables"),
}


@pytest.mark.parametrize("name", IMPORTER_FAULTS)
def test_a_fault_of_an_importer_is_named_by_its_check(log, name):
    importer, message = IMPORTER_FAULTS[name]
    with pytest.raises(tw.BrokenContract, match=f"^{name.partition(':')[0]}: .*{message}"):
        tw.check_importer(importer, log, RIG, "1")


def test_a_sound_importer_passes(log):
    tw.check_importer(_ranges, log, RIG, "1")
