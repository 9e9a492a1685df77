"""What a user installs: one name beside other people's packages, completed by editors and checked by type checkers."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path
from venv import EnvBuilder

import pytest

import trackwright as tw

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
LEFT_OUT = ("experiments/lab/benchmark/", "experiments/lab/validation/")
MINE = """import trackwright as tw

tw.build(3, [])
reveal_type(tw.evaluate)
reveal_type(tw.exchange.read_trajectory)
tw.nothing
"""


def _done(line, cwd):
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "MYPYPATH")}
    done = subprocess.run([*map(str, line)], cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    if re.search("No matching distribution|NewConnectionError", done.stderr):
        pytest.skip("no package index that pip can reach")
    return done


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    place = tmp_path_factory.mktemp("wheel")
    for name in ("trackers", "sim", "tuning", "experiments", "trackwright"):
        shutil.copytree(ROOT / name, place / name, symlinks=True)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, place / name)
    done = _done([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", place, "-w", place], place)
    assert done.returncode == 0, done.stderr
    (wheel,) = place.glob("trackwright-*.whl")
    return wheel


@pytest.fixture(scope="module")
def beside(wheel, tmp_path_factory):
    """An environment with the wheel, PyPI's trackers and a type checker; what ours depends on is that of this one."""
    place = tmp_path_factory.mktemp("environment")
    EnvBuilder(with_pip=True, symlinks=True).create(place)
    python = place / "bin" / "python"
    for what in (["trackers", "basedpyright"], ["--no-deps", wheel]):
        done = _done([python, "-m", "pip", "install", "-q", *what], place)
        assert done.returncode == 0, done.stderr
    (packages,) = (place / "lib").glob("python3*/site-packages")
    (packages / "ours.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return python


def test_a_wheel_has_all_files_under_one_name_and_the_command(wheel):
    held = set(zipfile.ZipFile(wheel).namelist())
    assert {re.split("[/-]", name)[0] for name in held} == {"trackwright"}
    ours = [
        f"trackwright/{path.relative_to(ROOT).as_posix()}"
        for package in ("trackers", "sim", "tuning", "experiments")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and not path.relative_to(ROOT).as_posix().startswith(LEFT_OUT)
    ]
    assert not [name for name in ours if not name.endswith((".md", ".json", ".pyc")) and name not in held]
    assert not [name for name in held if name.startswith(tuple(f"trackwright/{folder}" for folder in LEFT_OUT))]
    assert {"trackwright/py.typed", "trackwright/__init__.pyi"} <= held
    (entry,) = (name for name in held if name.endswith("entry_points.txt"))
    assert b"trackwright = trackwright.experiments.cli.main:main" in zipfile.ZipFile(wheel).read(entry)


def test_the_wheel_runs_beside_the_trackers_of_pypi(beside, tmp_path):
    program = "import trackers, trackwright as tw; print(trackers.SORTTracker.__name__, tw.baselines.fix_tracker, tw.__file__)"
    done = _done([beside, "-c", program], tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("SORTTracker <function fix_tracker")
    assert Path(done.stdout.split()[-1]).is_relative_to(beside.parents[1])
    for words in (["simulate", "ranges", "--n", 2, "--out", "made"], ["track", "made", "--out", "tracked"]):
        done = _done([beside.with_name("trackwright"), *words], tmp_path)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "tracked" / "tracks.parquet").exists()


@pytest.mark.parametrize("installed", ["wheel", "editable"])
@pytest.mark.parametrize("checker", ["mypy", "pyright"])
def test_type_checkers_check_calls_in_a_users_project(beside, checker, installed, tmp_path):
    python = beside if installed == "wheel" else sys.executable
    (tmp_path / "mine.py").write_text(MINE)
    line = [sys.executable, "-m", "mypy", "--python-executable", python, "--ignore-missing-imports", "mine.py"]
    if checker == "pyright":
        line = [beside.with_name("basedpyright"), "--pythonpath", python, "mine.py"]
    shown = _done(line, tmp_path).stdout
    assert re.search(
        r"mine.py:3.*(Argument 1 to .build. has incompatible|cannot be assigned to parameter .name.)", shown
    ), shown
    assert re.search(r"mine.py:4.*Evaluation", shown), shown
    assert re.search(r"mine.py:5.*DataFrame", shown), shown
    assert re.search(r"mine.py:6.*nothing|mine.py:6.*no attribute", shown), shown


def test_an_editor_in_a_users_project_finds_every_public_name(tmp_path):
    jedi = pytest.importorskip("jedi", reason="comes with ipykernel")
    EnvBuilder(with_pip=False, symlinks=True).create(tmp_path / "env")
    (packages,) = (tmp_path / "env" / "lib").glob("python3*/site-packages")
    (packages / "trackwright").symlink_to(ROOT / "trackwright")
    (tmp_path / "project").mkdir()
    script = jedi.Script(
        "import trackwright as tw\ntw.",
        environment=jedi.create_environment(tmp_path / "env", safe=False),
        project=jedi.Project(tmp_path / "project"),
    )
    completions = {completion.name for completion in script.complete(2, 3)}
    assert {*tw.__all__} <= completions
