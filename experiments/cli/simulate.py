"""`trackwright simulate station`, `line`, `ranges` … `agv`: each world of `sim.worlds` as a command."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

from cyclopts import Parameter

from trackwright.experiments.cli.main import new_app
from trackwright.experiments.cli.options import Folder
from trackwright.sim import worlds
from trackwright.sim.worlds import ParameterError
from trackwright.trackers.core.errors import UnusableInput

if TYPE_CHECKING:
    from trackwright.sim.tables import SimulatedWorld

HELP = {  # of the options that all worlds share
    "out": "the folder to write, one recording in Parquet; it must not exist or be empty.",
    "n": "trajectories, each of a tag, or body, of its own.",
    "seed": "the same seed gives the same numbers; a trajectory depends on the seed and its own number alone.",
}


def command(world: Callable[..., SimulatedWorld]) -> Callable[..., int]:
    """The command of a world: its parameters as options, and `--out`."""

    def simulate(out: Any, **given: Any) -> int:
        numbers = {p.name: given.get(p.name, p.default) for p in options[1:]}
        from trackwright.experiments.cli.console import write_manifest
        from trackwright.trackers.core.errors import counted
        from trackwright.trackers.recordings.folder import write_recording

        try:
            folder = world(**numbers).folder()
        except ParameterError as error:
            words = error.value if isinstance(error.value, (tuple, list)) else [error.value]
            option = f"--{error.name.replace('_', '-')} {' '.join(map(str, words))}"
            raise UnusableInput(f"{option}: expected {error.expected}") from error
        write_recording(folder, out)
        write_manifest(out, numbers=numbers, seed=numbers["seed"])
        sizes = ", ".join(f"{name} {counted(len(table), 'row')}" for name, table in folder.tables.items())
        print(f"wrote {out}: {counted(len(folder.rig.tags), 'tag')}, {sizes}")
        return 0

    hints, own = {"out": Folder} | get_type_hints(world, include_extras=True), inspect.signature(world).parameters
    shared = {name: Annotated[hints[name], Parameter(help=text)] for name, text in HELP.items()}
    keyword, defaults = inspect.Parameter.KEYWORD_ONLY, {name: p.default for name, p in own.items() if name != "ids"}
    options = [
        inspect.Parameter(name, keyword, default=default, annotation=(hints | shared)[name])
        for name, default in ({"out": inspect.Parameter.empty} | defaults).items()
    ]
    simulate.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    simulate.__annotations__, simulate.__doc__ = {p.name: p.annotation for p in options}, world.__doc__
    return simulate


_WORLDS = "station", "line", "ranges", "tdoa", "fusion", "body", "tool", "agv"
simulate = new_app("simulate", f"Simulate a recording with truth: {', '.join(_WORLDS)}.")
for _world in (getattr(worlds, name) for name in _WORLDS):
    simulate.command(command(_world), name=_world.__name__, sort_key=len(simulate._commands))
