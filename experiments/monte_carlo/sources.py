"""Load a study: by name from the papers of `experiments.lab`, from a file, or from what travelled."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import pkgutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from trackwright.experiments.jobs.portable import Files, copied
from trackwright.experiments.monte_carlo.declaration import Study, TrackerConfig, World, checked
from trackwright.experiments.monte_carlo.store import first_difference, identity
from trackwright.sim.worlds import WORLDS
from trackwright.trackers.core.errors import UnusableInput, near
from trackwright.trackers.core.user_file import fault_of, run_file, split_name
from trackwright.trackers.recordings.input_file import read_toml

PAPERS = "trackwright.experiments.lab.papers"  # in whose folders studies are looked for by name
KINDS = {str: "text", int: "a whole number", float: "a number", list: "a list", dict: "a table", bool: "true or false"}
STUDY_KEYS = {
    "name": str, "about": str, "runs": int, "seed": int, "metrics": list,
    "worlds": dict, "trackers": dict, "grid": dict,
}  # fmt: skip
TRACKER_KEYS = {"tracker": str, "tunables": dict, "smooth": bool, "free_height": bool, "every": float}


def available_studies() -> list[str]:
    """The names of the studies that come with the package."""
    return sorted(_modules())


def _modules() -> dict[str, str]:
    """Module names by study: each module of a paper's folder, except fits and private ones."""
    found = (m.name for folder in _modules_in(PAPERS) if folder.ispkg for m in _modules_in(folder.name))
    named = ((module.rpartition(".")[2], module) for module in found)
    return {name.replace("_", "-"): module for name, module in named if not name.startswith(("fit_", "_"))}


def _modules_in(package: str) -> Iterator[pkgutil.ModuleInfo]:
    return pkgutil.iter_modules(importlib.import_module(package).__path__, f"{package}.")


def load_study(what: str, tracker_files: Mapping[str, str] | None = None) -> Study:
    """The study of a name or file; raises UnusableInput. `tracker_files`: other places of users' files."""
    study = dataclasses.replace(_declared(what), declared_in=what)
    return checked(_with_trackers_from(tracker_files, study) if tracker_files else study)


def _with_trackers_from(files: Mapping[str, str], study: Study) -> Study:
    """The study with the users' files of trackers in other places."""
    trackers = dict(study.trackers)
    for name, config in study.trackers.items():
        file, attribute = split_name(config.tracker) if isinstance(config.tracker, str) else ("", "")
        if file in files:
            trackers[name] = dataclasses.replace(config, tracker=f"{files[file]}:{attribute}")
    return dataclasses.replace(study, trackers=trackers)


def _declared(what: str) -> Study:
    path = Path(what)
    if path.suffix == ".toml":
        return _from_toml(path)
    if path.suffix == ".py":
        return _from_python(path)
    modules = _modules()
    if what not in modules:
        known = f"expected a .toml or .py file or one of {', '.join(sorted(modules))}"
        raise UnusableInput(f"study '{what}': unknown{near(what, sorted(modules))}; {known}")
    module = importlib.import_module(modules[what])
    return _with_source(module, Path(str(module.__file__)))


def _with_source(module: Any, path: Path) -> Study:
    study = getattr(module, "STUDY", None)
    if not isinstance(study, Study):
        words = "expected `STUDY = Study(...)` of trackwright.experiments.monte_carlo"
        raise UnusableInput(f"{path}: no STUDY found; {words}")
    return dataclasses.replace(study, source=path.read_text("utf-8"))


def _from_python(path: Path) -> Study:
    if not path.is_file():
        raise UnusableInput(f"{path}: no such file; expected a Python file with `STUDY = Study(...)`")
    try:
        module = run_file(path, f"trackwright_study_{path.stem}")
    except UnusableInput:
        raise
    except Exception as error:
        raise UnusableInput(f"{path}: raises {fault_of(error, path)}; correct the file") from error
    return _with_source(module, path)


def _from_toml(path: Path) -> Study:
    content = read_toml(path, "a study")
    _check_keys(path, "", content, STUDY_KEYS)
    trackers = {}
    for name, table in content.get("trackers", {}).items():
        _check_keys(path, f"trackers.{name}", table, TRACKER_KEYS)
        trackers[name] = TrackerConfig(**{"tracker": name, **table})
    for name, values in content.get("grid", {}).items():
        if not isinstance(values, list):
            raise UnusableInput(f"{path}: grid.'{name}' = {values!r}; expected a list of values")
    return Study(
        name=content.get("name", path.stem),
        about=content.get("about", ""),
        worlds={name: _world(path, name, table) for name, table in content.get("worlds", {}).items()},
        trackers=trackers,
        source=path.read_text("utf-8-sig"),
        **{k: content[k] for k in ("runs", "seed", "metrics", "grid") if k in content},
    )


def _world(path: Path, name: str, table: Any) -> World:
    where = f"worlds.{name}"
    if not isinstance(table, Mapping):
        raise UnusableInput(f"{path}: {where} = {table!r}; expected a table, [{where}]")
    if "world" in table:
        world = table["world"]
        raise UnusableInput(f"{path}: '{where}.world' is unknown; the world is kind = {world!r}; rename the key")
    kind = table.get("kind", name)
    if not isinstance(kind, str) or kind not in WORLDS:
        raise UnusableInput(f"{path}: {where}: kind '{kind}' is unknown; expected one of {', '.join(WORLDS)}")
    return World(WORLDS[kind], {k: v for k, v in table.items() if k != "kind"})


def _check_keys(path: Path, where: str, table: Any, keys: Mapping[str, type]) -> None:
    """Refuse anything but a table with these keys and types."""
    if not isinstance(table, Mapping):
        raise UnusableInput(f"{path}: {where} = {table!r}; expected a table, [{where}]")
    for key, value in table.items():
        full = f"{where}.{key}" if where else key
        if key not in keys:
            raise UnusableInput(f"{path}: '{full}' is unknown; expected {', '.join(keys)}")
        # A whole number is a number; a bool is neither, although Python counts it as an int.
        if type(value) not in ((int, float) if keys[key] is float else (keys[key],)):
            raise UnusableInput(f"{path}: {full} = {value!r}; expected {KINDS[keys[key]]}")


class PortableStudy(NamedTuple):
    """The declaration of a study as loaded by name or file; raises UnusableInput for any other one."""

    what: str
    files: Files
    runs: int
    seed: int

    @classmethod
    def of(cls, study: Study) -> PortableStudy:
        """The declaration of a study as it travels: its name or file, the users' files, runs and seed."""
        where = f"study '{study.name}'"
        if not study.declared_in:
            fix = "expected one that other processes can build; write it to a file and load it with load_study"
            raise UnusableInput(f"{where}: was built in memory; {fix}")
        again = _numbered(load_study(study.declared_in), study.runs, study.seed)
        difference = first_difference(identity(again), identity(study))
        if difference:
            fix = "expected the same, since other processes build it from there; write the change to the file"
            raise UnusableInput(f"{where}: differs from its declaration {study.declared_in} ({difference}); {fix}")
        names = [config.tracker for config in study.trackers.values() if isinstance(config.tracker, str)]
        trackers = sorted({file for file, _ in map(split_name, names) if file})
        files = {file: Path(file).read_text("utf-8") for file in trackers}
        if Path(study.declared_in).suffix in (".toml", ".py"):
            files = {study.declared_in: study.source, **files}
        return cls(study.declared_in, tuple(files.items()), study.runs, study.seed)

    def study(self) -> Study:
        """The study; the files' texts stand for the files."""
        with copied(self.files) as places:
            return _numbered(load_study(places.get(self.what, self.what), places), self.runs, self.seed)


def _numbered(study: Study, runs: int, seed: int) -> Study:
    return checked(dataclasses.replace(study, runs=runs, seed=seed))
