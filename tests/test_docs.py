"""The Markdown code that users copy is run, so that it can't rot."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]


def _blocks(path):
    return re.findall(r"^```python\n(.*?)^```", (ROOT / path).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def extended():
    """What stands in the namespace after all Python blocks of docs/extending.md have run in order."""
    names = {"__name__": "extending"}
    for block in _blocks("docs/extending.md"):
        exec(compile(block, "docs/extending.md", "exec", dont_inherit=True), names)
    return names


def test_a_motion_and_a_sensor_of_ones_own_take_under_30_lines_together():
    first = _blocks("docs/extending.md")[0]
    code = first[first.index("class Walker") :].splitlines()
    assert sum(1 for line in code if line.strip()) < 30


@pytest.mark.slow
def test_the_extended_tracker_follows_its_walk(extended):
    estimates, true = extended["estimates"], extended["walks"][0].truth["position"][0]
    error = np.linalg.norm(np.stack(list(estimates.mean.position), axis=-1) - true, axis=-1)
    assert estimates.summary() == "ok"
    # A single range has 0.3 m of noise; a filter over about 2.7 ranges a row stays well below it.
    assert np.sqrt(np.mean(error[10:] ** 2)) < 0.3


@pytest.mark.slow
def test_fitting_the_extended_tracker_finds_the_noise_its_ranges_were_drawn_with(extended):
    result = extended["result"]
    found, error = result.values["sensors.ranges.sigma_r"], result.standard_errors["sensors.ranges.sigma_r"]
    assert abs(found - 0.3) < 3 * error


def test_the_python_example_of_the_readme_runs_and_finds_the_simulated_phase_noise():
    names = {"__name__": "readme"}
    for block in _blocks("README.md"):
        exec(compile(block, "README.md", "exec", dont_inherit=True), names)
    assert names["estimates"].summary() == "ok"
    # 64 tags x 100 rows x 7 numbers: one part in 300 of statistics, and a few percent because the wave isn't plane.
    assert abs(float(names["tuned"].sensors["phases"].sigma_p.value) / 0.3 - 1) < 0.05


@pytest.mark.parametrize(("system", "first", "last"), [("A", 1, 21), ("C", 8, 37), ("D", 1, 20)])
def test_the_papers_page_has_one_row_for_each_numbered_equation(system, first, last):
    text = (ROOT / "docs/papers.md").read_text(encoding="utf-8")
    section = text.split(f"## {system}. ")[1].split("\n## ")[0]
    numbers = []
    for row in re.findall(r"^\| (\(\d+\).*?) \|", section, re.MULTILINE):
        low, high = re.match(r"\((\d+)\)(?:–\((\d+)\))?", row).groups()
        numbers += range(int(low), int(high or low) + 1)
        numbers += [int(n) for n in re.findall(r", \((\d+)\)", row)]
    assert sorted(numbers) == list(range(first, last + 1))


@pytest.mark.parametrize("page", ["docs/papers.md", "docs/decisions.md", "docs/extending.md", "README.md"])
def test_every_place_in_the_code_that_a_page_names_exists(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    for path, name in re.findall(r"`((?:trackers|sim|tuning|experiments|tests)/[\w/]+\.py)(?:: ([\w.]+))?`", text):
        code = (ROOT / path).read_text(encoding="utf-8")
        for part in filter(None, name.split(".")):
            assert re.search(rf"^ *(?:def|class) {part}\b|^{part} = ", code, re.MULTILINE), f"{path} has no {part}"


def test_every_link_of_the_readme_leads_to_a_file():
    links = re.findall(r"\]\(([^)#:]+)\)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert links
    assert all((ROOT / rts_gain).is_file() for rts_gain in links)
