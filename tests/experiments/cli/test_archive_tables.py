"""Which folders make an archive, and metrics from sums over rows beside those of all rows at once."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import polars as pl
import pytest

from tests.experiments.cli.small_archive import recording
from trackwright.experiments.cli.archive_folders import MANY, archive_of, recordings_under
from trackwright.experiments.cli.archive_part import ERRORS, TRACKED, outcome_of
from trackwright.sim import worlds
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.evaluate import evaluate, rows_of
from trackwright.trackers.evaluation.metrics import added, metrics
from trackwright.trackers.recordings.atomic import json_text


def _touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def test_folders_of_folders_many_recordings_and_keep_going_make_an_archive(tmp_path):
    _touch(tmp_path, "a/rig.toml", "a/old/rig.toml", "b/deep/ranges.csv.gz", "b/notes.csv", ".c/rig.toml", "d/x.txt")
    (tmp_path / "b" / "loop").symlink_to(tmp_path)
    found = [tmp_path / "a", tmp_path / "b" / "deep"]
    assert recordings_under(tmp_path) == found
    assert archive_of([tmp_path], False) == found
    assert archive_of(found, False) is None
    assert archive_of(found, True) == found
    assert archive_of([tmp_path / "d"], False) is None
    many = [tmp_path / f"r{k}" for k in range(MANY + 1)]
    assert archive_of(many[1:], False) is None
    assert archive_of(many, False) == many
    with pytest.raises(UnusableInput, match="more than once"):
        archive_of([tmp_path, tmp_path / "a"], False)


def _bearings(folder, rng):
    truth = folder.tables["truth"]
    columns = ("azimuth_rad", "elevation_rad", "std_azimuth_rad", "std_elevation_rad")
    tables = [
        pl.DataFrame({"recording": [folder.name] * len(truth), "tag": truth["tag"], "station": [name] * len(truth)})
        .with_columns(t_s=truth["t_s"], nis=pl.lit(1.5), nis_dof=pl.lit(2.0), status=pl.lit("ok"))
        .with_columns(**{column: rng.uniform(0.1, 0.3, len(truth)) for column in columns})
        for name in folder.rig.stations
    ]
    return pl.concat(tables)


@pytest.mark.parametrize(("bearing", "rows"), [(False, 800), (False, 4), (True, 200)])
def test_metrics_from_sums_are_those_of_all_rows_at_once(bearing, rows):
    if bearing:
        rng = np.random.default_rng(2)
        folders = [dataclasses.replace(worlds.station(1, k, rows=rows).folder(), name=f"r{k}") for k in range(3)]
        tables = [_bearings(folder, rng) for folder in folders]
    else:
        folders = [recording(f"r{k}", k, rows=rows) for k in range(3)]
        tables = [build("fix-kf", folder).run(folder).table for folder in folders]
    kept, errors = [], []
    for folder, table in zip(folders, tables, strict=True):
        outcome = outcome_of(dict.fromkeys(("tracker", "short", "endings")), rows_of(table, folder), {}, {}, TRACKED)
        kept.append(json.loads(json_text(outcome.summary))["sums"])
        errors.append(outcome.tables[ERRORS[TRACKED]])
    found = metrics(added(pl.DataFrame(kept, infer_schema_length=None), pl.concat(errors).lazy())).row(0, named=True)
    expected = evaluate(pl.concat(tables), folders).overall
    assert list(found) == list(expected)
    for name, value in expected.items():
        assert found[name] == (value if value is None else pytest.approx(value, rel=1e-12, abs=1e-15)), name
