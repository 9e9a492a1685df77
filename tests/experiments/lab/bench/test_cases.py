"""The table of benchmarks: every one explains itself and runs, in its smallest size."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys

import pytest

from trackwright.experiments.cli.arguments import new_app
from trackwright.experiments.lab.bench import growth, growth_cases, waiting_split
from trackwright.experiments.lab.bench.__main__ import CASES
from trackwright.experiments.lab.bench.timing import function_of
from trackwright.experiments.lab.subprocesses import REPOSITORY

QUICK = ("waiting", "cluster-plan")
"""Those that compile nothing."""

PARTS = {
    "growth": ("anchors", "tunables"),
    "lanes": ("--states", "4", "--lanes", "1"),
    "studies": ("--tracker", "fix-kf", "uwb"),
    "recordings": ("--recordings", "labyrinth", "--smooth"),
}
"""Arguments of those whose other parts take long, or need libraries that are no dependencies."""


def _bench(*words):
    """A finished `python -m trackwright.experiments.lab.bench …`."""
    command = [sys.executable, "-m", "trackwright.experiments.lab.bench", *map(str, words)]
    return subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False, env=os.environ)


def test_without_a_name_all_benchmarks_are_listed_with_a_sentence():
    done = _bench()
    assert done.returncode == 0
    lines = done.stdout.splitlines()
    assert [line.split()[0] for line in lines] == [*CASES]
    assert all(len(line.split()) > 3 for line in lines)


@pytest.mark.parametrize("name", CASES)
def test_a_benchmark_explains_its_options_among_them_those_that_all_have(name, capsys):
    app = new_app(name)
    app.default(function_of(CASES[name]))
    app(["--help"])
    assert {"--small", "--out", "--page"} <= {*capsys.readouterr().out.split()}


def test_an_unknown_name_is_refused_with_the_known_ones():
    done = _bench("fast")
    assert done.returncode == 2
    assert "no benchmark fast" in done.stderr
    assert "growth" in done.stderr


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in CASES if n != "gpu"]
)
def test_a_benchmark_runs_in_its_smallest_size(name, recordings, tmp_path):
    out = tmp_path / "results.json"
    done = _bench(name, *PARTS.get(name, ()), "--small", "--out", out)
    assert done.returncode in (0, 1), done.stderr
    found = json.loads(out.read_text("utf-8"))
    assert found["command"][:4] == ["python", "-m", "trackwright.experiments.lab.bench", name]
    assert {"date", "commit", "machine", "packages"} <= found.keys()
    tables = found["tables"].values() if "tables" in found else [found["rows"]]
    assert all(rows for rows in tables)
    assert not [row for rows in tables for row in rows if "failed" in row]


def test_every_series_has_its_problem():
    assert {*growth.SERIES, "bearings", "inertial", "form", "smoothed"} == {*growth_cases.BUILDERS}


def test_what_is_timed_within_a_command_exists():
    for module, functions in waiting_split.FUNCTIONS.items():
        text = REPOSITORY.joinpath(*module.split("."))
        source = text.with_suffix(".py") if text.with_suffix(".py").exists() else text / "__init__.py"
        for name in functions:
            assert re.search(rf"^def {name}\(", source.read_text("utf-8"), re.M), f"{module}.{name}"
