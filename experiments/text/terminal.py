"""Standard error: notices, and the stages of a command as bars on a terminal, as lines at intervals in a pipe."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from threading import Event, Thread
from time import monotonic

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from trackwright.trackers.core.errors import one_line

ERRORS = Console(stderr=True, highlight=False, soft_wrap=True)

FIRST_LINE, LAST_INTERVAL = 10.0, 60.0
"""Seconds to the first line in a pipe, and between later ones at most; the interval doubles from the first."""


def notice(text: str) -> None:
    """Prints one line on standard error."""
    ERRORS.print(one_line(text), markup=False)


Advance = Callable[..., None]
"""`advance(done, now="")` advances the bar of a stage by `done`; `now` is appended to its name."""

Begin = Callable[..., Advance]
"""`begin(name, total=None)` begins a stage, which ends the one before; `total`: of its bar, None if unknown."""


@contextmanager
def stages(what: str) -> Iterator[Begin]:
    """The stages of the command `what`; yields the function that begins one.

    What is printed meanwhile comes after the bars, which are removed then.
    """
    terminal = sys.stderr.isatty() and not ERRORS.quiet
    columns = TextColumn("{task.description} {task.fields[now]}"), BarColumn(20), TextColumn("{task.fields[count]}")
    bars = Progress(*columns, TimeElapsedColumn(), console=ERRORS, disable=not terminal, transient=True,
                    redirect_stdout=False)  # fmt: skip
    ended, printed, since = Event(), io.StringIO(), [monotonic()]

    def begin(name: str, total: int | None = None) -> Advance:
        for task in bars.tasks[-1:]:
            bars.update(task.id, total=max(task.completed, 1), completed=max(task.completed, 1))
        since[0], of = monotonic(), "" if total is None else f" of {total}"
        number = bars.add_task(name, total=total, now="", count=of and f"0{of}")

        def advance(done: int, now: str = "") -> None:
            reached = int(bars.tasks[number].completed) + done
            bars.update(number, completed=reached, now=now, count=of and f"{reached}{of}")

        return advance

    def lines() -> None:
        interval = FIRST_LINE
        while not ended.wait(interval):
            for task in bars.tasks[-1:]:
                words = f"{task.description} {task.fields['count']}".rstrip(), f"{monotonic() - since[0]:.0f} s"
                ERRORS.print(f"{what}: {', '.join(filter(None, (*words, task.fields['now'])))}", markup=False)
            interval = min(2 * interval, LAST_INTERVAL)

    try:
        with bars, redirect_stdout(printed) if terminal else nullcontext():
            if not terminal:
                Thread(target=lines, daemon=True).start()
            yield begin
    finally:
        ended.set()
        sys.stdout.write(printed.getvalue())
