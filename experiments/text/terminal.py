"""Standard error: notices, and the stages of a command as bars on a terminal, as lines at intervals in a pipe.

A stage is named when it begins. `compiling` is no stage of a command but of jax, which reports when XLA has a program
to compile and when that is done; it has a row of its own.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import dataclass, field
from threading import Event, Lock, Thread
from time import monotonic
from typing import Any, Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from trackwright.trackers.core.errors import one_line

ERRORS = Console(stderr=True, highlight=False, soft_wrap=True)

FIRST_LINE, LAST_INTERVAL = 10.0, 60.0
"""Seconds to the first line in a pipe, and between later ones at most; the interval doubles from the first."""

LOWERED, COMPILED = "jaxpr_to_mlir_module_duration", "backend_compile_duration"
"""Ends of the names of jax's events before and after XLA compiles a program."""


def notice(text: str) -> None:
    """Prints one line on standard error."""
    ERRORS.print(one_line(text), markup=False)


class Advance(Protocol):
    """Advances the bar of a stage by `done`; `now` is appended to its name."""

    def __call__(self, done: int, now: str = "") -> None: ...


class Begin(Protocol):
    """Begins a stage, which ends the one before; `total`: of its bar, none where that is unknown."""

    def __call__(self, name: str, total: int | None = None) -> Advance: ...


@dataclass
class Compilation:
    """The programs that XLA compiles at present, how many it has compiled, and the seconds that took."""

    begun: list[float] = field(default_factory=list)
    done: int = 0
    seconds: float = 0.0
    lock: Lock = field(default_factory=Lock)
    listening: bool = False

    def listen(self) -> None:
        """Hear of jax's events, once jax is imported."""
        if not self.listening and "jax.monitoring" in sys.modules:
            sys.modules["jax.monitoring"].register_event_duration_secs_listener(self.heard)
            self.listening = True

    def heard(self, event: str, seconds: float, **about: Any) -> None:
        """One event of jax, whose duration has ended."""
        with self.lock:
            if event.endswith(LOWERED):
                self.begun.append(monotonic())
            elif event.endswith(COMPILED):
                self.done, self.seconds = self.done + 1, self.seconds + seconds
                del self.begun[:1]

    def now(self) -> str:
        """What is compiled at present, in words; empty for nothing."""
        with self.lock:
            return f"compiling {monotonic() - self.begun[0]:.0f} s" if self.begun else ""


COMPILATION = Compilation()


class Stages:
    """The stages begun so far, and their bars."""

    def __init__(self, what: str, bars: Progress) -> None:
        self.what, self.bars = what, bars
        self.task: TaskID | None = None
        self.compiling: TaskID | None = None
        self.name, self.done, self.note, self.since = "", 0, "", monotonic()
        self.total: int | None = None
        # A program that was lowered before and never compiled, as for an export, is none of this command's.
        COMPILATION.begun.clear()
        self.compiled_before = COMPILATION.done, COMPILATION.seconds

    def begin(self, name: str, total: int | None = None) -> Advance:
        """As `Begin`."""
        COMPILATION.listen()
        self.end()
        self.name, self.total, self.done, self.note, self.since = name, total, 0, "", monotonic()
        task = self.task = self.bars.add_task(name, total=total, count=self.count())

        def advance(done: int, now: str = "") -> None:
            self.done, self.note = self.done + done, now
            self.bars.update(task, advance=done, count=self.count(), description=f"{name} {now}" if now else name)

        return advance

    def end(self) -> None:
        """Stops the clock of the present stage."""
        if self.task is not None:
            done = max(self.done, 1)
            self.bars.update(self.task, total=done, completed=done, description=self.name)

    def update_compiling(self) -> None:
        """Draws the row of jax's compilations, if there have been any."""
        COMPILATION.listen()
        done, seconds = (
            a - b for a, b in zip((COMPILATION.done, COMPILATION.seconds), self.compiled_before, strict=True)
        )
        words = COMPILATION.now() or (f"compiled {done} program{'s'[: done != 1]} in {seconds:.0f} s" if done else "")
        if not words:
            return
        if self.compiling is None:
            self.compiling = self.bars.add_task(words, total=None, count="")
        done_bar = None if COMPILATION.begun else 1
        self.bars.update(self.compiling, description=words, total=done_bar, completed=done_bar)

    def count(self) -> str:
        """How much of the stage is done; empty where its total is unknown."""
        return "" if self.total is None else f"{self.done} of {self.total}"

    def line(self) -> str:
        """The present stage as a line for a pipe."""
        stage, seconds = f"{self.name} {self.count()}".rstrip(), f"{monotonic() - self.since:.0f} s"
        words = [stage, seconds, COMPILATION.now(), self.note]
        return f"{self.what}: {', '.join(x for x in words if x)}"


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
    """Keeps the row of compilations up to date, or prints lines at intervals, until the command ends."""
    if terminal:
        while not ended.wait(0.25):
            shown.update_compiling()
        return
    interval = FIRST_LINE
    while not ended.wait(interval):
        if shown.name:
            ERRORS.print(shown.line(), markup=False)
        interval = min(2 * interval, LAST_INTERVAL)


@contextmanager
def progress(what: str, total: int) -> Iterator[Advance]:
    """One stage of known length; yields the function that advances it."""
    with stages(what) as begin:
        yield begin(what, total)
