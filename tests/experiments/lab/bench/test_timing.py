"""One timer and one fresh process."""

from __future__ import annotations

import time

import numpy as np
import pytest

from trackwright.experiments.lab.bench.timing import (
    Version,
    apart,
    cold_and_warm,
    compared,
    last_line,
    timed_command,
)


def test_a_ratio_is_that_of_the_rates_of_rows():
    def busy(seconds):
        return lambda: time.sleep(seconds)

    fast, slow = compared({"ours": Version(10, 4, busy(0.05)), "theirs": Version(5, 4, busy(0.1))}, 3)
    assert fast["ours × faster"] == 1
    assert slow["ours × faster"] == pytest.approx(4, rel=0.5)
    assert slow["run ms"] == pytest.approx(100, rel=0.5)
    assert fast["M rows/s"] == pytest.approx(40 / 0.05 / 1e6, rel=0.5)


def test_the_first_call_is_apart_from_the_warm_ones():
    calls = []

    def run():
        calls.append(np.ones(10_000_000 if not calls else 1).sum())
        while len(calls) == 1 and time.process_time() < began + 0.2:
            pass

    began = time.process_time()
    found = cold_and_warm(run, rows=100, rounds=3)
    assert len(calls) == 4
    assert found["first call, processor s"] > 0.1
    assert found["processor ms"] < 50
    assert found["processor µs/row"] == pytest.approx(1e3 * found["processor ms"] / 100)


def test_a_function_in_a_new_process_answers_or_says_why_not():
    assert apart("cases:cell", 12345, limit_s=60) == "12,345"
    assert "status 1: " in apart("cases:cell", limit_s=60)["failed"]
    assert "took over 0 s" in apart("cases:cell", 1, limit_s=0.01)["failed"]


def test_a_command_is_measured_with_what_it_did(tmp_path):
    log, seen = tmp_path / "log.txt", []
    program = "x = bytearray(150_000_000)\nimport time\nt = time.process_time()\nwhile time.process_time() < t + 0.3: pass\nprint('done')\nraise SystemExit(3)"
    run = timed_command(["-c", program], tmp_path, log, watch=seen.append)
    assert run["code"] == 3
    assert run["cpu_s"] >= 0.3
    assert run["peak_mb"] > 150
    assert len({*seen}) == 1
    assert last_line(log) == "done"
