"""`--json` of commands that print tables: the same results, to be read by programs."""

from __future__ import annotations

import json

import polars as pl
import pytest

from tests.in_process import trackwright


def test_check_prints_its_results_by_folder(beginnings):
    folder = beginnings / "good"
    text, plain = trackwright("check", folder), trackwright("check", folder, "--json")
    assert (plain.code, plain.err) == (text.code, text.err)
    (results,) = json.loads(plain.out).values()
    assert len(results) == len(text.out.splitlines()) - 2
    assert all(result["message"] in text.out for result in results)
    assert {result["level"] for result in results} <= {"error", "warning", "info"}


def test_report_prints_the_differences_of_evaluated_files(beginnings, tmp_path):
    truth = pl.read_csv(beginnings / "good" / "truth.csv").filter(pl.col("tag") == "T1")
    for name, error in (("near", 0.1), ("far", 0.3)):
        truth.select("t_s", pl.col("x_m") + error, "y_m", "z_m").write_csv(tmp_path / f"{name}.csv")
        arguments = ("--truth", beginnings / "good", "--tag", "T1", "--out", tmp_path / name)
        assert trackwright("evaluate", tmp_path / f"{name}.csv", *arguments).code == 0
    said = trackwright("report", tmp_path / "near", tmp_path / "far", "--json", "--out", tmp_path / "page.html")
    assert said.code == 0, said.err
    contrasts = json.loads(said.out)["contrasts"]
    (rmse,) = (c for c in contrasts if c["metric"] == "rmse_m" and c["subject"] == "")
    assert rmse["difference"]["first"] == pytest.approx(0.1)
    assert rmse["difference"]["second"] == pytest.approx(0.3)
