"""Where studies come from: the ones of this project by name, a Python file, a TOML file."""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import importlib.util
import pkgutil
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments import papers, questions
from experiments.monte_carlo.declaration import Study, TrackerConfig, World, checked
from sim.worlds import WORLDS
from trackers.core.errors import UnusableInput

STUDY_KEYS = {
    "name": str, "about": str, "runs": int, "seed": int, "metrics": list,
    "worlds": dict, "trackers": dict, "grid": dict,
}  # fmt: skip
TRACKER_KEYS = {"tracker": str, "tunables": dict, "smooth": bool, "free_height": bool, "every": (int, float)}


def available_studies() -> list[str]:
    """The studies of this project."""
    return sorted(_modules())


def _modules() -> dict[str, str]:
    """The module of each study by the study's name: one file a study in the folders of the papers, and `questions`."""
    places = [m.name for m in pkgutil.iter_modules(papers.__path__, "experiments.papers.") if m.ispkg]
    found = {}
    for place in [*places, questions.__name__]:
        for module in pkgutil.iter_modules(importlib.import_module(place).__path__, f"{place}."):
            name = module.name.rpartition(".")[2]
            if not name.startswith(("fit_", "_")):
                found[name.replace("_", "-")] = module.name
    return found


def load_study(what: str) -> Study:
    """A study by name or file; raises UnusableInput where there is none and where it can't be run."""
    path = Path(what)
    if path.suffix == ".toml":
        return checked(_from_toml(path))
    if path.suffix == ".py":
        return checked(_from_python(path))
    modules = _modules()
    if what not in modules:
        near = difflib.get_close_matches(what, sorted(modules), 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise UnusableInput(
            f"study '{what}': unknown{hint}; expected a .toml or .py file or one of {', '.join(sorted(modules))}"
        )
    module = importlib.import_module(modules[what])
    return checked(_with_source(module, Path(str(module.__file__))))


def _with_source(module: Any, path: Path) -> Study:
    study = getattr(module, "STUDY", None)
    if not isinstance(study, Study):
        raise UnusableInput(f"{path}: no STUDY in it; expected `STUDY = Study(...)` of experiments.monte_carlo")
    return dataclasses.replace(study, source=path.read_text("utf-8"))


def _from_python(path: Path) -> Study:
    if not path.is_file():
        raise UnusableInput(f"{path}: is not there; expected a Python file with `STUDY = Study(...)`")
    # Under a name of its own in sys.modules: dataclasses and pickles in the file look for it there.
    name = f"trackwright_study_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except UnusableInput:
        raise
    except Exception as error:
        line = str(error).splitlines()[0] if str(error) else "no message"
        raise UnusableInput(f"{path}: cannot be run ({type(error).__name__}: {line}); correct the file") from error
    return _with_source(module, path)


def _from_toml(path: Path) -> Study:
    try:
        text = path.read_text("utf-8")
        content = tomllib.loads(text)
    except OSError as error:
        raise UnusableInput(f"{path}: cannot be read ({error.strerror}); expected a study in TOML") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UnusableInput(f"{path}: is not valid TOML ({str(error).splitlines()[0]}); correct it") from error
    if "figures" in content:
        raise UnusableInput(f"{path}: the key 'figures' is now called 'metrics'; rename it")
    _of_kinds(path, "", content, STUDY_KEYS)
    trackers = {}
    for name, table in content.get("trackers", {}).items():
        where = f"trackers.{name}"
        _of_kinds(path, where, table, TRACKER_KEYS)
        trackers[name] = TrackerConfig(**{"tracker": name, **table})
    return Study(
        name=content.get("name", path.stem),
        about=content.get("about", ""),
        worlds={name: _world(path, name, table) for name, table in content.get("worlds", {}).items()},
        trackers=trackers,
        source=text,
        **{k: content[k] for k in ("runs", "seed", "metrics", "grid") if k in content},
    )


def _world(path: Path, name: str, table: Any) -> World:
    where = f"worlds.{name}"
    if not isinstance(table, Mapping):
        raise UnusableInput(f"{path}: {where} = {table!r}; expected a table, [{where}]")
    kind = table.get("kind", name)
    if kind not in WORLDS:
        raise UnusableInput(f"{path}: {where}: kind '{kind}' is unknown; expected one of {', '.join(WORLDS)}")
    return World(WORLDS[kind], {k: v for k, v in table.items() if k != "kind"})


def _of_kinds(path: Path, where: str, table: Any, kinds: Mapping[str, Any]) -> None:
    """Refuse what isn't a table of these keys and kinds."""
    if not isinstance(table, Mapping):
        raise UnusableInput(f"{path}: {where} = {table!r}; expected a table, [{where}]")
    for key, value in table.items():
        full = f"{where}.{key}" if where else key
        if key not in kinds:
            raise UnusableInput(f"{path}: '{full}' is unknown; expected {', '.join(kinds)}")
        if not isinstance(value, kinds[key]) or (isinstance(value, bool) and kinds[key] is not bool):
            raise UnusableInput(f"{path}: {full} = {value!r}; expected {_kind(kinds[key])}")
        if key == "grid" and not all(isinstance(v, list) for v in value.values()):
            raise UnusableInput(f"{path}: grid: expected a list of values for every name")


def _kind(kind: Any) -> str:
    words = {str: "text", int: "a whole number", list: "a list", dict: "a table", bool: "true or false"}
    return words.get(kind, "a number")
