"""The Markdown code that users copy is run, so that it can't rot."""

from __future__ import annotations

import importlib
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from tests.in_process import PLAIN, trackwright
from trackwright.experiments.lab.demo import REAL
from trackwright.trackers.core import on_demand
from trackwright.trackers.recordings.kinds import KINDS

ROOT = Path(__file__).parents[1]


def _blocks(path):
    return re.findall(r"^```python\n(.*?)^```", (ROOT / path).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def extended():
    """What stands in the namespace after all Python blocks of docs/extending.md have run in order."""
    names = {"__name__": "extending"}
    for block in _blocks("docs/extending.md"):
        # Those that are files of their own are tested as such.
        if not block.startswith("# "):
            exec(compile(block, "docs/extending.md", "exec", dont_inherit=True), names)
    return names


@pytest.mark.slow
def test_the_parts_of_the_page_of_extending_keep_their_contracts(extended):
    tw.check_motion(extended["walking"], extended["somewhere"])
    tw.check_sensor(extended["ranges"], extended["somewhere"])


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
    fitted, error = result.values["sensors.ranges.sigma_r"], result.standard_errors["sensors.ranges.sigma_r"]
    assert abs(fitted - 0.3) < 3 * error


def _run(page, folder, monkeypatch):
    """The namespace after the Python blocks of a page have run in order, in the folder."""
    monkeypatch.chdir(folder)
    names = {"__name__": page}
    for block in _blocks(page):
        exec(compile(block, page, "exec", dont_inherit=True), names)
    return names


@pytest.mark.slow
def test_the_python_example_of_the_readme_runs_and_lowers_the_negative_log_likelihood(tmp_path, monkeypatch):
    shutil.copytree(REAL, tmp_path / "out/demo/recordings")
    names = _run("README.md", tmp_path, monkeypatch)
    assert names["result"].value < names["result"].start_value
    assert len(names["table"]) == len(names["estimates"].to_polars())


@pytest.mark.slow
def test_the_page_for_those_who_come_from_filterpy_fits_their_matrices(tmp_path, monkeypatch):
    names = _run("docs/coming-from.md", tmp_path, monkeypatch)
    assert names["fitted"].value < names["fitted"].start_value
    assert names["position"].shape == names["sigma"].shape == names["z"].shape


@pytest.mark.slow
def test_the_sentences_of_the_concepts_run_in_order_from_folders_and_from_arrays(tmp_path, monkeypatch):
    names = _run("docs/concepts.md", tmp_path, monkeypatch)
    assert (tmp_path / "my-folder" / "rig.toml").is_file()
    # The fixes of the line's tags are off by 0.44 m, root mean square.
    assert names["metrics"]["rmse_m"] < 0.3
    assert names["tw"].evaluate(names["in_arrays"], names["mine"])["rmse_m"] < 0.1
    assert isinstance(names["tuned"], type(names["tracker"]))


@pytest.fixture
def turning(tmp_path, monkeypatch):
    """A folder with the tracker of docs/extending.md as a file, and a simulated recording of two vehicles."""
    (block,) = (b for b in _blocks("docs/extending.md") if b.startswith("# turning.py"))
    (tmp_path / "turning.py").write_text(block, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert trackwright("simulate", "agv", "--out", "agv", "--n", 2, "--rows", 100).code == 0
    return tmp_path


def test_a_tracker_of_ones_own_is_tracked_by_file(turning):
    done = trackwright("track", "agv", "--tracker", "turning.py:TURNING", "--out", "out")
    assert done.code == 0, done.err
    tracks = pl.read_parquet("out/tracks.parquet")
    truth = pl.read_parquet("agv/truth.parquet")
    apart = tracks.join(truth, on=["tag", "t_s"]).filter(pl.col("t_s") > 1)
    # The fixes have 0.1 m of noise in x and in y.
    assert apart.select(((pl.col("x_m") - pl.col("x_m_right")) ** 2).mean().sqrt()).item() < 0.2


@pytest.mark.slow
def test_a_tracker_of_ones_own_is_checked_by_file(turning):
    """The rows of a vehicle that turns fast: its covariances are those of a linearised model."""
    (block,) = (b for b in _blocks("docs/extending.md") if b.startswith("# check_turning.py"))
    exec(block, {})


@pytest.mark.slow
def test_a_tracker_of_ones_own_is_tuned_swept_and_studied_by_file(turning):
    args = ("--tracker", "turning.py:TURNING")
    done = trackwright("tune", "agv", *args, "--tune", "sensors.*", "--steps", 4, "--out", "tuned")
    assert done.code == 0, done.err
    assert trackwright("sweep", "agv", *args, "--over", "sensors.fixes.sigma_fix=0.1:0.3:3", "--out", "swept").code == 0
    study = 'runs = 4\n[worlds.agv]\nrows = 50\n[trackers.turning]\ntracker = "turning.py:TURNING"\n[trackers.fix-kf]\n'
    (turning / "mine.toml").write_text(study, encoding="utf-8")
    done = trackwright("study", "mine.toml", "--out", "studied")
    assert done.code == 0, done.err
    assert "turning" in (turning / "studied" / "results.json").read_text(encoding="utf-8")


@pytest.fixture
def hall(tmp_path, monkeypatch):
    """A folder with both files of a kind of one's own, and a recording `hall` of it, while no program knows it."""
    for name in ("bistatic", "hall", "bistatic_log"):
        (block,) = (b for b in _blocks("docs/extending.md") if b.startswith(f"# {name}.py"))
        (tmp_path / f"{name}.py").write_text(block, encoding="utf-8")
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    made = importlib.import_module("hall")
    exec(re.search(r'^\$ python -c "(.*)"$', (ROOT / "docs/extending.md").read_text("utf-8"), re.MULTILINE)[1])
    yield made
    for name in ("bistatic", "hall"):
        sys.modules.pop(name, None)
    _as_in_a_new_process()


def _as_in_a_new_process() -> None:
    """Forgets the kind, and that its file was run."""
    KINDS.pop("bistatic", None)
    on_demand._module.cache_clear()


def test_a_kind_of_ones_own_is_read_checked_and_tracked(hall):
    recording = tw.read("hall")
    results = [f"{one.level} {one.where}: {one.message}" for one in tw.check(recording)]
    assert not [line for line in results if line.startswith(("error", "warning bistatic"))]
    metrics = tw.evaluate(tw.build("bistatic.py:TRACKER", recording).run(recording), recording)
    # Four paths of 0.15 m a row, ten rows a second.
    assert metrics["rmse_m"] < 0.15


OWN = ("--tracker", "bistatic.py:TRACKER")


@pytest.mark.slow
def test_a_kind_of_ones_own_is_checked_and_tracked_by_every_way_of_the_command_line(hall):
    _as_in_a_new_process()
    ignored = trackwright("check", "hall").out
    assert "bistatic.parquet (not one of the tables" in ignored
    assert "; check and track read your own kinds by --tracker FILE.py:NAME)" in ignored
    done = trackwright("check", "hall", *OWN)
    assert (done.code, "bistatic" in done.out) == (0, True)
    _as_in_a_new_process()
    done = trackwright("track", "hall", *OWN, "--out", "out")
    assert done.code == 0, done.err
    assert "path" in Path("out/report.html").read_text("utf-8")
    _as_in_a_new_process()
    shutil.copytree("hall", "archive/hall")
    done = trackwright("track", "archive", *OWN, "--out", "kept", *PLAIN)
    assert done.code == 0, done.err
    tracks = [pl.read_parquet(f"{out}/tracks.parquet").select("t_s", "tag", "x_m", "y_m") for out in ("out", "kept")]
    assert tracks[0].equals(tracks[1])


def test_a_kind_of_ones_own_is_imported_by_a_format_that_imports_its_file(hall):
    _as_in_a_new_process()
    sys.modules.pop("bistatic")
    Path("bistatic.log").write_text("0 1-2 1.5\n0.1 2-3 -0.5\n", encoding="utf-8")
    own = ("--format", "bistatic_log.py:read", "--tag", "T1", "--rig", "hall/rig.toml", "--out", "imported")
    done = trackwright("import", "bistatic.log", *own)
    assert done.code == 0, done.err
    assert tw.read("imported").tables["bistatic"]["path_m"].to_list() == [1.5, -0.5]


def test_a_kind_and_a_format_of_ones_own_are_checked_by_file(hall):
    lines = [f"{k / 10} {k % 4 + 1}-{(k + 1) % 4 + 1} {6.0 + 0.01 * k}" for k in range(40)]
    Path("bistatic.log").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (block,) = (b for b in _blocks("docs/extending.md") if b.startswith("# check_bistatic.py"))
    exec(block, {})


def test_swapped_signs_of_a_kind_of_ones_own_are_explained(hall):
    table = pl.read_parquet("hall/bistatic.parquet")
    table.with_columns(-pl.col("path_m")).write_parquet("hall/bistatic.parquet")
    errors = [one.message for one in tw.check(tw.read("hall")) if one.level == "error"]
    assert any("the bistatic multiplied by -1" in message for message in errors)


@pytest.mark.parametrize(
    "page", ["docs/papers.md", "docs/decisions.md", "docs/extending.md", "docs/concepts.md", "README.md"]
)
def test_every_place_in_the_code_that_a_page_names_exists(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    for path, name in re.findall(r"`((?:trackers|sim|tuning|experiments|tests)/[\w/]+\.py)(?:: ([\w.]+))?`", text):
        code = (ROOT / path).read_text(encoding="utf-8")
        for part in filter(None, name.split(".")):
            assert re.search(rf"^ *(?:def|class) {part}\b|^{part} = ", code, re.MULTILINE), f"{path} has no {part}"


def test_the_menu_of_the_site_and_the_readme_list_the_same_pages_for_users_and_for_makers():
    menu = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2].partition("exclude_docs")[0]
    readme = (ROOT / "README.md").read_text(encoding="utf-8").partition("## More")[2]
    listed = {}
    for reader in ("users", "makers"):
        sections = re.findall(rf'"For {reader}[^\n]*\n((?: {{6}}- .*\n)+)', menu)
        section = readme.partition(f"For {reader}")[2].partition("For makers")[0]
        listed[reader] = set(re.findall(r"\(docs/([\w-]+)\.\w+\)", section))
        assert {*re.findall(r"- ([\w-]+)\.md", "".join(sections))} - {"index"} == listed[reader] - {"api"}
    pages = {path.stem for path in (ROOT / "docs").iterdir() if path.suffix in (".md", ".ipynb")}
    assert set.union(*listed.values()) == pages


def test_the_citation_names_the_version_of_the_package():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text("utf-8")


@pytest.mark.parametrize("page", sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]), ids=lambda page: page.stem)
def test_every_link_of_a_page_leads_to_a_file_and_a_heading(page):
    for target in re.findall(r"\]\(((?!https?:)[^)]+)\)", page.read_text(encoding="utf-8")):
        name, _, heading = target.partition("#")
        path = page.parent / name if name else page
        assert path.is_file(), target
        if heading:
            headings = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
            assert heading in {re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-") for h in headings}, target


@pytest.mark.slow
def test_the_site_is_built_without_a_broken_link(tmp_path):
    pytest.importorskip("mkdocstrings", reason="the extra docs is not installed")
    line = [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(tmp_path)]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Smoothed" in "".join(page.read_text("utf-8") for page in (tmp_path / "api").glob("*.html"))
