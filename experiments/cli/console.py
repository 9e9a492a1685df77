"""What a person sees while a command runs: progress on a terminal, quiet in a pipe, notices on standard error."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from rich import box
from rich.console import Console, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from trackers.core.errors import UnusableInput
from trackers.recordings.folder import RecordingFolder, read_recording

ERRORS = Console(stderr=True, highlight=False, soft_wrap=True)


class Advance(Protocol):
    """Counts work done; `now` says in a few words how it stands."""

    def __call__(self, done: int, now: str = "") -> None: ...


@contextmanager
def progress(what: str, total: int) -> Iterator[Advance]:
    """A function that counts work done; draws a bar where standard error is a terminal."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=ERRORS, disable=not sys.stderr.isatty(), transient=True) as bar:
        task = bar.add_task(what, total=total)

        def advance(done: int, now: str = "") -> None:
            bar.update(task, advance=done, description=f"{what} {now}" if now else what)

        yield advance


def close_table(title: str) -> Table:
    """A table with a bold title and little room between its columns, for many of them."""
    return Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
        collapse_padding=True,
    )


def rendered(width: int, *parts: RenderableType) -> str:
    """Tables and plain lines as text of at most so many characters a line, without blanks at their ends."""
    page = io.StringIO()
    console = Console(file=page, width=width, highlight=False)
    for part in parts:
        console.print(part, markup=False)
    return "\n".join(line.rstrip() for line in page.getvalue().splitlines()) + "\n"


def notice(text: str) -> None:
    """One line for the person at the terminal, on standard error."""
    ERRORS.print(text, markup=False)


def read_all(paths: Sequence[Path]) -> list[RecordingFolder]:
    """All recording folders, their notices shown; raises UnusableInput for none, and for two of one name."""
    folders = []
    require_some(paths)
    twice = _repeated([path.resolve() for path in paths])
    if twice is not None:
        raise UnusableInput(f"{paths[twice]}: is given more than once; expected every recording in one place only")
    for path in paths:
        folders.append(read_recording(path))
        for text in folders[-1].notices:
            notice(f"notice: {path}: {text}")
    double = _repeated([folder.name for folder in folders])
    if double is not None:
        name = folders[double].name
        raise UnusableInput(f"two recordings are both named '{name}'; expected different names in rig.toml; rename one")
    return folders


def _repeated(items: Sequence[Any]) -> int | None:
    """The place of the first item that stands there more than once."""
    return next((k for k, item in enumerate(items) if items.count(item) > 1), None)


def require_some(paths: Sequence[Path]) -> None:
    """Raise UnusableInput where no recording is given."""
    if not paths:
        raise UnusableInput("no recording given; expected one or more recording folders")


def output_folder(path: Path) -> Path:
    """The folder, created where it isn't there; raises UnusableInput where that can't be, and for a recording."""
    if (path / "rig.toml").exists():
        raise UnusableInput(f"--out {path}: is a recording folder; expected one for results")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnusableInput(f"--out {path}: cannot be created ({error.strerror}); choose another folder") from error
    return path
