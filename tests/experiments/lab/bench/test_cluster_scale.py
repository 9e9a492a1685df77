"""The plan of a large study from rates that were measured."""

from __future__ import annotations

import json

import pytest

from trackwright.experiments.lab.bench.cluster_scale import MEASURED, cluster_plan, plan, rates_of
from trackwright.experiments.lab.cases import Output, cell

RATES = {
    "trajectories": 1000, "compute_s": 3.6, "caller_ms": 6.0, "store_ms": 30.0, "scheduler_ms": 3.6, "add_ms": 7.2,
    "chunk_bytes": 1e6, "caller_sent_bytes": 1e3, "caller_received_bytes": 4e6,
}  # fmt: skip


def test_a_plan_follows_from_its_rates():
    found = plan(RATES, 1e9, 50)
    assert found["chunks of 1,000 trajectories"] == 1e6
    assert found["computing, core-hours"] == pytest.approx(1000)
    assert found["computing on all workers, h"] == pytest.approx(20)
    assert found["caller: hand out, take in and store, h"] == pytest.approx(10)
    assert found["scheduler, h"] == pytest.approx(1)
    assert found["caller: add up the results, h"] == pytest.approx(2)
    assert found["from start to end, h"] == pytest.approx(22)
    assert found["paid for, core-hours"] == pytest.approx(1000)
    assert found["workers that these two keep busy"] == pytest.approx(100)
    assert found["chunk files, GB"] == pytest.approx(1000)
    assert found["over the caller's network, GB"] == pytest.approx(4001)
    assert found["the same, MB/s"] == pytest.approx(4.001e6 / (20 * 3600))


def test_workers_beyond_those_that_the_caller_keeps_busy_cost_and_do_not_hasten():
    many, enough = plan(RATES, 1e9, 1000), plan(RATES, 1e9, 100)
    assert many["from start to end, h"] == enough["from start to end, h"] == pytest.approx(12)
    assert many["paid for, core-hours"] == pytest.approx(10 * enough["paid for, core-hours"])


def test_a_plan_takes_the_scheduler_of_the_nearest_number_of_workers():
    clusters = [{"workers": 100, "scheduler_ms": 1.0}, {"workers": 1000, "scheduler_ms": 2.0}]
    measured = {"chunk": {"compute_s": 3.0}, "clusters": clusters}
    for workers, nearest in ((1, 0), (300, 0), (400, 1), (5000, 1)):
        assert rates_of(measured, workers) == {"compute_s": 3.0} | clusters[nearest]


def test_the_command_writes_the_plan_from_the_committed_rates_to_a_page(tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text(
        "before\n<!-- tables of trackwright.experiments.lab.bench cluster-plan -->\n<!-- end of the tables -->\nafter\n"
    )
    output = Output(page=page, out=tmp_path / "plan.json")
    assert cluster_plan(runs=1e9, workers=(64, 1000), price=0.5, output=output) == 0
    printed, written = capsys.readouterr().out, page.read_text()
    for workers in (64, 1000):
        expected = plan(rates_of(json.loads(MEASURED.read_text("utf-8")), workers), 1e9, workers)
        for value in (expected["computing on all workers, h"], 0.5 * expected["paid for, core-hours"]):
            assert cell(value) in printed
            assert cell(value) in written
    assert written.startswith("before\n")
    assert written.endswith("after\n")
