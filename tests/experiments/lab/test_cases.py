"""The cases of bench and validation: every one explains itself and runs, in its smallest size, and writes its results."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys

import pytest

from trackwright.experiments.cli.arguments import new_app
from trackwright.experiments.lab import cases
from trackwright.experiments.lab.bench import waiting_split
from trackwright.experiments.lab.bench.__main__ import CASES as BENCH
from trackwright.experiments.lab.cases import Output, Table, function_of
from trackwright.experiments.lab.subprocesses import REPOSITORY
from trackwright.experiments.lab.validation.__main__ import CASES as VALIDATION

CASES = [f"{folder}.{case}" for folder, own in (("bench", BENCH), ("validation", VALIDATION)) for case in own]
QUICK = ("bench.waiting", "bench.cluster_scale:cluster_plan")
"""Those that compile nothing."""

PARTS = {
    "bench.growth": ("anchors", "tunables", "bearings", "inertial", "form-4", "smoothed-fix-kf"),
    "bench.studies": ("--tracker", "fix-kf", "uwb"),
    "bench.recordings": ("--recordings", "labyrinth", "--smooth"),
    "validation.default_levels": ("bearings",),
    "validation.tuned_sites": ("--site", "isas", "--seconds", "10"),
    "validation.nis_expectation": ("fix-kf",),
    "validation.recovery": ("C",),
}
"""Arguments of those whose other parts take long, or need libraries that are no dependencies."""

ELSEWHERE = ("bench.gpu", "validation.real_recordings")
"""Those that tests of their own run."""


def _lab(folder, *words):
    """A finished process of `python -m trackwright.experiments.lab.FOLDER …`."""
    command = [sys.executable, "-m", f"trackwright.experiments.lab.{folder}", *map(str, words)]
    return subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False, env=os.environ)


@pytest.mark.parametrize(("folder", "own"), [("bench", BENCH), ("validation", VALIDATION)])
def test_without_a_name_all_cases_are_listed_with_a_sentence(folder, own, capsys, monkeypatch):
    monkeypatch.setattr(cases.sys, "argv", [folder])
    cases.run_case(folder, own)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0].replace("-", "_") for line in lines] == [case.rpartition(":")[2] for case in own]
    assert all(len(line.split()) > 3 for line in lines)


@pytest.mark.parametrize("case", CASES)
def test_a_case_explains_its_options_among_them_those_that_all_have(case, capsys):
    app = new_app(case)
    app.default(function_of(case))
    app(["--help"])
    words = {*capsys.readouterr().out.split()}
    assert {"--small", "--out", "--page"} <= words
    assert not words & {"--began", "--host"}


def test_an_unknown_name_is_refused_with_the_known_ones(capsys, monkeypatch):
    monkeypatch.setattr(cases.sys, "argv", ["bench", "fast"])
    with pytest.raises(SystemExit, match="2"):
        cases.run_case("bench", BENCH)
    assert "bench: no case fast; expected beam, " in capsys.readouterr().err


@pytest.mark.parametrize(
    "case", [c if c in QUICK else pytest.param(c, marks=pytest.mark.slow) for c in CASES if c not in ELSEWHERE]
)
def test_a_case_runs_in_its_smallest_size(case, recordings, tmp_path):
    out, (folder, _, name) = tmp_path / "results.json", case.partition(".")
    name = name.rpartition(":")[2].replace("_", "-")
    done = _lab(folder, name, *PARTS.get(case, ()), "--small", "--out", out)
    assert done.returncode in (0, 1), done.stderr
    found = json.loads(out.read_text("utf-8"))
    assert found["command"][:4] == ["python", "-m", f"trackwright.experiments.lab.{folder}", name]
    assert {"date", "commit", "machine", "packages"} <= found.keys()
    tables = found["tables"].values() if "tables" in found else [found["rows"]]
    assert all(rows for rows in tables)
    assert not [row for rows in tables for row in rows if "failed" in row]


def test_the_repository_is_the_checkout_and_not_its_folder_of_links():
    assert (REPOSITORY / "pyproject.toml").is_file()


def test_what_is_timed_within_a_command_exists():
    for module, functions in waiting_split.FUNCTIONS.items():
        text = REPOSITORY.joinpath(*module.split("."))
        source = text.with_suffix(".py") if text.with_suffix(".py").exists() else text / "__init__.py"
        for name in functions:
            assert re.search(rf"^def {name}\(", source.read_text("utf-8"), re.M), f"{module}.{name}"


def test_results_are_written_a_row_a_line_and_replace_the_tables_of_the_page(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cases.sys, "argv", ["bench", "--page", "page.md"])
    page, out = tmp_path / "page.md", tmp_path / "out" / "results.json"
    page.write_text(
        "before\n<!-- tables of trackwright.experiments.lab.bench lanes -->\nold\n<!-- end of the tables -->\nafter\n"
    )
    rows = [{"name": "a|b", "s": 0.12345678, "n": 12345, "none": None, "share": "**98.5 %**"}]
    rows.append({"name": "c", "s": 4321.0, "share": "3 %"})
    Output(out=out, page=page).publish("bench lanes", Table(rows, "one", "note"), Table(rows, "two"), device="card")
    found = json.loads(out.read_text("utf-8"))
    assert found["tables"] == {"one": rows, "two": rows}
    assert found["command"] == ["python", "-m", "trackwright.experiments.lab.bench", "lanes", "--page", "page.md"]
    assert found["device"] == "card"
    assert sum('"c"' in line for line in out.read_text("utf-8").splitlines()) == 2
    text = page.read_text()
    assert text.startswith("before\n<!-- tables")
    assert text.endswith("<!-- end of the tables -->\nafter\n")
    head = "| name | s | n | none | share |\n| --- | ---: | ---: | ---: | ---: |\n"
    body = "| a/b | 0.123 | 12,345 |  | **98.5 %** |\n| c | 4,321 |  |  | 3 % |\n"
    assert f"### one\n\n{head}{body}\nnote" in text
    assert "old" not in text
    assert "4,321" in capsys.readouterr().out


def test_bold_of_a_page_is_that_of_a_terminal_and_plain_in_a_pipe(monkeypatch):
    table = Table([{"name": "a", "share": "**98.5**"}, {"name": "b", "share": "3.0"}], note="**1** of 2")
    assert cases.as_text(table) == "name  share\na      98.5\nb       3.0\n1 of 2"
    monkeypatch.setattr(cases.sys.stdout, "isatty", lambda: True)
    assert cases.as_text(table) == "name  share\na      \x1b[1m98.5\x1b[0m\nb       3.0\n\x1b[1m1\x1b[0m of 2"
