"""Standard error: notices, and the stages of a command as bars on a terminal, as lines at intervals in a pipe.

A stage is named when it begins. `compiling` is no stage of a command but of jax, which reports when XLA has a program
to compile and when that is done.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from functools import cache
from threading import Event, Thread
from time import monotonic
from typing import Any, Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from trackwright.trackers.core.errors import one_line

ERRORS = Console(stderr=True, highlight=False, soft_wrap=True)

FIRST_LINE, LAST_INTERVAL = 10.0, 60.0
"""Seconds to the first line in a pipe, and between later ones at most; the interval doubles from the first."""

COMPILING: list[float] = []
"""When the programs that XLA compiles at present were begun."""


def notice(text: str) -> None:
    """Prints one line on standard error."""
    ERRORS.print(one_line(text), markup=False)


class Advance(Protocol):
    """Advances the bar of a stage by `done`; `now` is appended to its name."""

    def __call__(self, done: int, now: str = "") -> None: ...


class Begin(Protocol):
    """Begins a stage, which ends the one before; `total`: of its bar, none where that is unknown."""

    def __call__(self, name: str, total: int | None = None) -> Advance: ...


def _heard(event: str, seconds: float, **about: Any) -> None:
    """One event of jax, whose duration has ended."""
    if event.endswith("jaxpr_to_mlir_module_duration"):
        COMPILING.append(monotonic())
    elif event.endswith("backend_compile_duration"):
        del COMPILING[:1]


@cache
def _listen(monitoring: Any) -> None:
    monitoring.register_event_duration_secs_listener(_heard)


def _compiling() -> str:
    """What is compiled at present, in words; empty for nothing. Hears of jax's events once jax is imported."""
    if "jax.monitoring" in sys.modules:
        _listen(sys.modules["jax.monitoring"])
    return "".join(f"compiling {monotonic() - since:.0f} s" for since in COMPILING[:1])


class Stages:
    """The stages of a command and their bars; the last one is the present one."""

    def __init__(self, what: str, bars: Progress) -> None:
        self.what, self.bars, self.name = what, bars, ""
        self.total: int | None = None
        self.done, self.note, self.since = 0, "", monotonic()
        # A program that was lowered before and never compiled, as for an export, is none of this command's.
        COMPILING.clear()

    def begin(self, name: str, total: int | None = None) -> Advance:
        """As `Begin`."""
        if self.bars.tasks:
            self.draw(max(self.done, 1), total=max(self.done, 1), description=self.name)
        self.name, self.total, self.done, self.note, self.since = name, total, 0, "", monotonic()
        self.bars.add_task(name, total=total, count=self.count)

        def advance(done: int, now: str = "") -> None:
            self.done, self.note = self.done + done, now
            self.draw(self.done)

        return advance

    def draw(self, done: int, **more: Any) -> None:
        """Draws the bar of the present stage."""
        words = " ".join(filter(None, (self.name, self.note, _compiling())))
        self.bars.update(self.bars.tasks[-1].id, completed=done, count=self.count, **{"description": words} | more)

    @property
    def count(self) -> str:
        """How much of the stage is done; empty where its total is unknown."""
        return "" if self.total is None else f"{self.done} of {self.total}"

    def line(self) -> str:
        """The present stage as a line for a pipe."""
        words = [f"{self.name} {self.count}".rstrip(), f"{monotonic() - self.since:.0f} s", _compiling(), self.note]
        return f"{self.what}: {', '.join(filter(None, words))}"


@contextmanager
def stages(what: str) -> Iterator[Begin]:
    """The stages of the command `what`; yields the function that begins one.

    What is printed meanwhile comes after the bars, which are removed then.
    """
    terminal = sys.stderr.isatty() and not ERRORS.quiet
    columns = (TextColumn("{task.description}"), BarColumn(20), TextColumn("{task.fields[count]}"), TimeElapsedColumn())
    bars = Progress(*columns, console=ERRORS, disable=not terminal, transient=True, redirect_stdout=False)
    shown, ended, printed = Stages(what, bars), Event(), io.StringIO()
    watch = Thread(target=_watch, args=(shown, ended, terminal), daemon=True)
    try:
        with bars, redirect_stdout(printed) if terminal else nullcontext():
            watch.start()
            try:
                yield shown.begin
            finally:
                ended.set()
                watch.join()
    finally:
        sys.stdout.write(printed.getvalue())


def _watch(shown: Stages, ended: Event, terminal: bool) -> None:
    """Keeps the bar up to date, or prints lines at intervals, until the command ends."""
    interval = 0.25 if terminal else FIRST_LINE
    while not ended.wait(interval):
        if shown.name and terminal:
            shown.draw(shown.done)
        elif shown.name:
            ERRORS.print(shown.line(), markup=False)
        interval = interval if terminal else min(2 * interval, LAST_INTERVAL)


@contextmanager
def progress(what: str, total: int) -> Iterator[Advance]:
    """One stage of known length; yields the function that advances it."""
    with stages(what) as begin:
        yield begin(what, total)
