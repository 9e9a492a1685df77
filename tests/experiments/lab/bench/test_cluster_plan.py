"""The plan of a large study from rates that were measured."""

from __future__ import annotations

import json

import pytest

from experiments.lab.bench.cluster_plan import MEASURED, main, plan, rates_of

RATES = {
    "trajectories": 1000, "compute_s": 3.6, "caller_ms": 6.0, "store_ms": 30.0, "scheduler_ms": 3.6, "add_ms": 7.2,
    "chunk_bytes": 1e6, "caller_sent_bytes": 1e3, "caller_received_bytes": 4e6,
}  # fmt: skip


def test_a_plan_follows_from_its_rates():
    found = plan(RATES, 1e9, 50)
    assert found.chunks == 1e6
    assert found.core_hours == pytest.approx(1000)
    assert (found.compute_h, found.caller_h, found.scheduler_h, found.results_h) == pytest.approx((20, 10, 1, 2))
    assert found.elapsed_h == pytest.approx(22)
    assert found.paid_core_hours == pytest.approx(1000)
    assert found.busy == pytest.approx(100)
    assert (found.stored_bytes, found.caller_bytes) == pytest.approx((1e12, 4.001e12))


def test_workers_beyond_those_that_the_caller_keeps_busy_cost_and_do_not_hasten():
    many, enough = plan(RATES, 1e9, 1000), plan(RATES, 1e9, 100)
    assert many.elapsed_h == enough.elapsed_h == pytest.approx(12)
    assert many.paid_core_hours == pytest.approx(10 * enough.paid_core_hours)
    assert plan(RATES, 1e9, 100, conditions=3).paid_core_hours == pytest.approx(3 * enough.paid_core_hours)


def test_a_plan_takes_the_scheduler_of_the_nearest_number_of_workers():
    clusters = [{"workers": 100, "scheduler_ms": 1.0}, {"workers": 1000, "scheduler_ms": 2.0}]
    measured = {"chunk": {"compute_s": 3.0}, "clusters": clusters}
    for workers, nearest in ((1, 0), (300, 0), (400, 1), (5000, 1)):
        assert rates_of(measured, workers) == {"compute_s": 3.0} | clusters[nearest]


def test_the_command_writes_the_plan_from_the_committed_rates_to_a_page(tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text(
        "before\n<!-- tables of experiments.lab.bench.cluster_plan -->\n<!-- end of the tables -->\nafter\n"
    )
    assert main(runs=1e9, workers=(64, 1000), price=0.5, page=page) == 0
    printed, written = capsys.readouterr().out, page.read_text()
    for workers in (64, 1000):
        expected = plan(rates_of(json.loads(MEASURED.read_text("utf-8")), workers), 1e9, workers)
        for text in (f"{expected.chunks:,}", f"{0.5 * expected.paid_core_hours:,.2f}"):
            assert text in printed
            assert text in written
    assert written.startswith("before\n")
    assert written.endswith("after\n")
