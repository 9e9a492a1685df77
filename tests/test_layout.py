"""The rules of the house that a parser can keep: who imports whom, names, sizes, and the table of public names."""

from __future__ import annotations

import ast
import re
from collections import Counter
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from types import FunctionType

import pytest

import trackwright as tw

ROOT = Path(__file__).parents[1]
PACKAGES = ("trackers", "sim", "tuning", "experiments")
SYSTEMS = ("baselines", "aoa", "line", "uwb_imu", "mhk", "fusion")
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("test_*.py"))
LONGEST = 500
MODULES = ("sim", "tuning", "aoa", "baselines", "evaluation", "exchange", "line", "mhk", "parts", "uwb_imu")
PUBLIC = {"tw": tw, **{f"tw.{name}": getattr(tw, name) for name in MODULES}}


def _part(module):
    """What a module of ours belongs to: a folder of trackers or experiments, `trackers` itself, a package; else None."""
    package, _, rest = module.partition(".")
    if package == "trackers":
        inside, _, beyond = rest.partition(".")
        if inside == "core" and beyond.partition(".")[0] in CORE:
            return f"core.{beyond.partition('.')[0]}"
        known = ("core", "recordings", "parts", "evaluation", "exchange", "conformance", *SYSTEMS)
        return inside if inside in known else "trackers"
    if module.startswith("tuning.survey"):
        return module.split(".")[1]
    if package == "experiments":
        return f"experiments.{rest.partition('.')[0]}"
    return package if package in PACKAGES else None


CORE = ("model", "filters", "data", "run")
ENGINE = {"core", *(f"core.{folder}" for folder in CORE)}
BASE = {*ENGINE, "recordings", "parts"}
LIBRARY = {*BASE, *SYSTEMS, "evaluation", "exchange", "conformance", "trackers"}
MAY_IMPORT = {
    "core": {"core"},
    "core.model": {"core", "core.model"},
    "core.filters": {"core", "core.model", "core.filters"},
    "core.data": {"core", "core.model", "core.data"},
    "core.run": ENGINE,
    "recordings": {*ENGINE, "recordings"},
    "parts": BASE,
    **{system: {*BASE, system} for system in SYSTEMS},
    "fusion": {*BASE, *SYSTEMS},
    "evaluation": {*BASE, *SYSTEMS, "evaluation"},
    "exchange": {*ENGINE, "recordings", "evaluation", "exchange"},
    "conformance": {*ENGINE, "recordings", "exchange", "conformance"},
    "trackers": LIBRARY,
    "sim": {*LIBRARY, "sim"},
    "tuning": {*BASE, "tuning"},
    "survey": {*LIBRARY, "tuning", "survey"},
}
LAYERS = ("text", "jobs", "monte_carlo", "pages", "cli", "lab")
"""The folders of experiments; each imports itself and those before it."""

OUTSIDE = {*LIBRARY, "sim", "tuning", "survey"}
for count, layer in enumerate(LAYERS, 1):
    MAY_IMPORT[f"experiments.{layer}"] = {*OUTSIDE, *(f"experiments.{below}" for below in LAYERS[:count])}
MAY_IMPORT["experiments."], MAY_IMPORT["experiments.__main__"] = set(), {"experiments.cli"}


@cache
def _imports(path):
    """Every import of the file, wherever in it."""
    tree = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    return [node for node in tree if isinstance(node, ast.Import | ast.ImportFrom)]


def _imported(path):
    """Every module that the file imports; ours without `trackwright.`."""
    for node in _imports(path):
        if isinstance(node, ast.Import):
            yield from (alias.name.removeprefix("trackwright.") for alias in node.names)
        else:
            assert node.level == 0, f"{path}: relative import; the rule reads whole names"
            module = node.module.removeprefix("trackwright.")
            yield module
            if module == "trackers":
                yield from (f"trackers.{alias.name}" for alias in node.names)


def _named(path):
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def test_a_module_imports_only_what_its_part_may():
    forbidden = [
        f"{name} imports {module}"
        for path, name in zip(SOURCES, map(_named, SOURCES), strict=True)
        for module in _imported(path)
        if _part(module) not in {None, *MAY_IMPORT[_part(name)]}
    ]
    assert not forbidden


def test_no_modules_import_each_other_in_a_circle():
    names = {_named(path): path for path in SOURCES}
    imports = {name: _modules_of(path) & names.keys() - {name} for name, path in names.items()}
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        pytest.fail(f"import circle: {' -> '.join(reversed(error.args[1]))}")


def _modules_of(path):
    """Every name that the file imports, and `package.name` for each `from package import name`, TYPE_CHECKING included."""
    members = {
        f"{n.module}.{a.name}".removeprefix("trackwright.")
        for n in _imports(path)
        if isinstance(n, ast.ImportFrom)
        for a in n.names
    }
    return {*_imported(path), *members}


def test_matplotlib_is_imported_under_experiments_alone():
    users = [p for p in SOURCES if any(m.partition(".")[0] == "matplotlib" for m in _imported(p))]
    assert users
    assert all(path.is_relative_to(ROOT / "experiments") for path in users)


FILES = ("trackers.recordings", "tuning.tuned_file", "tuning.checkpoint")
"""The modules of the library that may open files: those of recordings, tuned numbers and checkpoints."""


def test_the_library_prints_nothing_and_opens_files_in_few_places_only():
    calls = [
        f"{_named(path)}: {node.func.id}"
        for path in SOURCES
        if not path.is_relative_to(ROOT / "experiments")
        for forbidden in [("print", "input") if _named(path).startswith(FILES) else ("print", "input", "open")]
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in forbidden
    ]
    assert not calls


def test_parts_of_jax_that_it_does_not_promise_are_imported_in_one_module():
    private = ("jax._src", "jax.extend", "jax.interpreters")
    users = {_named(path) for path in SOURCES if any(module.startswith(private) for module in _imported(path))}
    assert users == {"trackers.core.jax_private"}


def test_a_file_has_one_idea_and_at_most_500_lines():
    assert not [_named(path) for path in SOURCES if len(path.read_text("utf-8").splitlines()) > LONGEST]


def test_every_test_file_is_found_by_pytest():
    files = (ROOT / "tests").rglob("*.py")
    assert sorted(file for file in files if re.search(r"^def test_", file.read_text("utf-8"), re.M)) == TESTS


@pytest.mark.parametrize("package", PUBLIC)
def test_the_page_of_names_lists_exactly_the_public_names(package):
    page = (ROOT / "docs/api.md").read_text("utf-8")
    rows = re.findall(rf"^\| `{re.escape(package)}` \|[^|]*\|(.*)\|$", page, re.M)
    listed = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert sorted(listed) == sorted(PUBLIC[package].__all__)


def test_a_public_name_is_in_one_place():
    places = Counter(name for package in PUBLIC.values() for name in package.__all__)
    assert not [name for name, count in places.items() if count > 1]


def test_every_public_name_exists_and_has_a_docstring():
    public = {(package, name): getattr(PUBLIC[package], name) for package in PUBLIC for name in PUBLIC[package].__all__}
    bare = [key for key, value in public.items() if isinstance(value, (type, FunctionType)) and not value.__doc__]
    assert not bare
