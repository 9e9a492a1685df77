"""`trackwright simulate station`, `line`, `ranges` … `agv`: each world of `sim.worlds` as a command."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, get_type_hints

from trackwright.experiments.cli.commands import new_app
from trackwright.experiments.cli.options import Folder
from trackwright.sim import worlds
from trackwright.sim.worlds import ParameterError
from trackwright.trackers.core.errors import UnusableInput

if TYPE_CHECKING:
    from trackwright.sim.worlds import SimulatedWorld

COMMON = """
    out: the folder to write; it must not exist or be empty.
    n: trajectories, each of a tag, or body, of its own.
    seed: the same seed gives the same numbers; a trajectory depends on the seed and its own number alone."""
"""The help of the options that all worlds share."""


def command(world: Callable[..., SimulatedWorld]) -> Callable[..., int]:
    """The command of a world: its parameters as options, and `--out`."""

    def simulate(out: Any, **given: Any) -> int:
        numbers = {p.name: given.get(p.name, p.default) for p in options[1:]}
        started = datetime.now(UTC)
        from trackwright.experiments.cli.console import write_manifest
        from trackwright.trackers.core.wording import counted
        from trackwright.trackers.recordings.folder import write_recording

        try:
            folder = world(**numbers).folder()
        except ParameterError as error:
            words = error.value if isinstance(error.value, (tuple, list)) else [error.value]
            option = f"--{error.name.replace('_', '-')} {' '.join(map(str, words))}"
            raise UnusableInput(f"{option}: expected {error.expected}") from error
        write_recording(folder, out)
        write_manifest(out, {k: x for k, x in numbers.items() if k != "seed"}, started, seeds=[numbers["seed"]])
        sizes = ", ".join(f"{name} {counted(len(table), 'row')}" for name, table in folder.tables.items())
        print(f"wrote {out}: {counted(len(folder.rig.tags), 'tag')}, {sizes}")
        return 0

    signature, hints = inspect.signature(world), get_type_hints(world, include_extras=True)
    keyword = inspect.Parameter.KEYWORD_ONLY
    options = [
        inspect.Parameter("out", keyword, annotation=Folder),
        *(p.replace(kind=keyword, annotation=hints[name]) for name, p in signature.parameters.items() if name != "ids"),
    ]
    simulate.__signature__ = signature.replace(parameters=options, return_annotation=int)  # type: ignore[attr-defined]
    simulate.__annotations__ = {p.name: p.annotation for p in options} | {"return": int}
    # From Python 3.13 on docstrings have no indentation of their own.
    summary, _, arguments = inspect.cleandoc(world.__doc__ or "").partition("\n")
    before, head, after = arguments.partition("Args:")
    text = f"{summary}\n\nWrites one recording folder, its tables in Parquet.\n{before}"
    simulate.__doc__ = f"{text}{head}{COMMON}{after}"
    return simulate


_WORLDS = "station", "line", "ranges", "tdoa", "fusion", "body", "tool", "agv"
simulate = new_app("simulate", f"Simulate a recording with truth: {', '.join(_WORLDS)}.")
for _world in (getattr(worlds, name) for name in _WORLDS):
    simulate.command(command(_world), name=_world.__name__, sort_key=len(simulate._commands))
