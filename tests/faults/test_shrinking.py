"""Any cell, and any value of a TOML file, is read or refused in a line; hypothesis shrinks one that is not."""

from __future__ import annotations

import tomllib
from pathlib import Path

import polars as pl
import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.faults.judged import faults_of
from tests.faults.texts import CALIBRATION, MAPPING, TUNED
from tests.faults.values import CELLS, IDS
from tests.faulty import RIG, good_tables
from trackwright.trackers.core.errors import UnusableInput, has_control
from trackwright.trackers.exchange.mapping_file import read_mapping
from trackwright.trackers.recordings.calibration import read_calibration
from trackwright.trackers.recordings.rig_file import read_rig
from trackwright.tuning.tuned_file import read_tuned

FEW, MANY = 12, 2000
TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
CELL = st.one_of(st.floats().map(repr), st.integers().map(str), st.sampled_from(CELLS), TEXT)
VALUE = st.recursive(
    st.one_of(
        st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(), TEXT, st.sampled_from(IDS), st.datetimes(), st.dates(), st.times()
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(TEXT, inner, max_size=3)),
    max_leaves=8,
)  # fmt: skip
READERS = {
    "rig.toml": (RIG, read_rig), "tuned.toml": (TUNED, read_tuned), "calibration.toml": (CALIBRATION, read_calibration),
    "mapping.toml": (MAPPING, read_mapping),
}  # fmt: skip


def _tried(count, **drawn):
    """The test of a property with so many examples, the same ones each time."""
    quiet = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
    own = settings(max_examples=count, derandomize=True, deadline=None, suppress_health_check=quiet, database=None)
    return lambda test: own(given(**drawn)(test))


def _check_cell(folder: Path, row: int, column: int, cell: str) -> None:
    table = good_tables()["fixes"].head(20).cast(pl.String)
    name = table.columns[column % len(table.columns)]
    at = pl.int_range(pl.len()) == row
    folder.mkdir(exist_ok=True)
    (folder / "rig.toml").write_text(RIG)
    table.with_columns(pl.when(at).then(pl.lit(cell)).otherwise(name).alias(name)).write_csv(folder / "fixes.csv")
    assert faults_of(("check", folder), folder)[0] == ""


def _check_value(path: Path, place: int, value) -> None:
    text, read = READERS[path.name]
    content = tomllib.loads(text)
    places = [*_places(content)]
    inside, key = places[place % len(places)]
    inside[key] = value
    path.write_text(tomli_w.dumps(content), "utf-8", newline="")
    said = ""
    try:
        read(path)
    except UnusableInput as problem:
        said = str(problem)
    assert not has_control(said)


def _places(content):
    """Every table or list of a TOML file with a key of it."""
    pairs = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in pairs:
        yield content, key
        if isinstance(value, dict | list):
            yield from _places(value)


CELLS_DRAWN = {"row": st.integers(0, 19), "column": st.integers(0, 5), "cell": CELL}
VALUES_DRAWN = {"place": st.integers(0, 200), "value": VALUE}


@_tried(FEW, **CELLS_DRAWN)
def test_any_cell_is_read_or_refused_in_a_line(tmp_path, row, column, cell):
    _check_cell(tmp_path / "recording", row, column, cell)


@pytest.mark.parametrize("name", READERS)
@_tried(4 * FEW, **VALUES_DRAWN)
def test_any_value_is_read_or_refused_in_a_line(tmp_path, name, place, value):
    _check_value(tmp_path / name, place, value)


@pytest.mark.slow
@_tried(MANY, **CELLS_DRAWN)
def test_many_cells_are_read_or_refused_in_a_line(tmp_path, row, column, cell):
    _check_cell(tmp_path / "recording", row, column, cell)


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
@_tried(10 * MANY, **VALUES_DRAWN)
def test_many_values_are_read_or_refused_in_a_line(tmp_path, name, place, value):
    _check_value(tmp_path / name, place, value)
