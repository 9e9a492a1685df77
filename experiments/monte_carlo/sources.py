"""Load a study by name from the papers of `experiments.lab` or from a file, or again in a worker."""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from pydantic import StrictInt, StrictStr

from trackwright.experiments.monte_carlo.declaration import DEFAULT_METRICS, Study, TrackerConfig, World, checked
from trackwright.sim.worlds import WORLDS
from trackwright.trackers.core.errors import UnusableInput, listed, near
from trackwright.trackers.core.on_demand import from_file
from trackwright.trackers.recordings.files import read_model

PAPERS = "trackwright.experiments.lab.papers"  # in whose folders studies are looked for by name


@dataclass(frozen=True)
class StudyFile:
    """A study in TOML, as `Study`; of a world all keys but `kind` are its parameters."""

    __pydantic_config__: ClassVar = {"extra": "forbid"}

    name: StrictStr = ""
    about: StrictStr = ""
    runs: StrictInt = 200
    seed: StrictInt = 0
    metrics: list[Any] = field(default_factory=lambda: [*DEFAULT_METRICS])
    worlds: dict[str, dict[str, Any]] = field(default_factory=dict)
    trackers: dict[str, TrackerConfig] = field(default_factory=dict)
    grid: dict[str, list[Any]] = field(default_factory=dict)


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


def load_study(what: str, runs: int | None = None, seed: int | None = None) -> Study:
    """The study of a name or file, with its own numbers or these; raises UnusableInput."""
    study = _declared(what)
    runs, seed = study.runs if runs is None else runs, study.seed if seed is None else seed
    return checked(dataclasses.replace(study, declared_in=what, runs=runs, seed=seed))


def _declared(what: str) -> Study:
    path = Path(what)
    if path.suffix == ".toml":
        return _from_toml(path)
    if path.suffix == ".py":
        study = from_file(f"{path}:STUDY", "study", "Study", lambda x: isinstance(x, Study))
    else:
        modules = _modules()
        if what not in modules:
            known = f"expected a .toml or .py file or one of {', '.join(sorted(modules))}"
            raise UnusableInput(f"study '{what}': unknown{near(what, sorted(modules))}; {known}")
        module = importlib.import_module(modules[what])
        study, path = module.STUDY, Path(str(module.__file__))
    return dataclasses.replace(study, source=path.read_text("utf-8"))


def _from_toml(path: Path) -> Study:
    content = read_model(path, StudyFile, f"the keys {listed((x.name for x in dataclasses.fields(StudyFile)), 9)}")
    trackers = {k: dataclasses.replace(x, tracker=x.tracker or k) for k, x in content.trackers.items()}
    worlds = {name: _world(f"{path}: worlds.{name}", name, table) for name, table in content.worlds.items()}
    changed = {"name": content.name or path.stem, "worlds": worlds, "trackers": trackers}
    return Study(**{**vars(content), **changed, "source": path.read_text("utf-8-sig")})


def _world(where: str, name: str, table: Mapping[str, Any]) -> World:
    kind = table.get("kind", name)
    if not isinstance(kind, str) or kind not in WORLDS:
        raise UnusableInput(f"{where}: kind '{kind}' is unknown; expected one of {', '.join(WORLDS)}")
    return World(WORLDS[kind], {k: v for k, v in table.items() if k != "kind"})
