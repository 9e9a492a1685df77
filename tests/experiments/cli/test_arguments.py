"""The arguments of a command are read as its function declares them, and refused in one line."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, get_args

import pytest
from cyclopts import CycloptsError, Parameter

from trackwright.experiments.cli import options
from trackwright.experiments.cli.arguments import new_app, refusal
from trackwright.experiments.cli.options import OPTIONS, File, Folder, Pattern, Recording, Seconds
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.exchange import pose_errors


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class _Shared:
    """Options of several commands.

    Args:
        from_: seconds,
            on two lines.
        tag: these tags alone.
    """

    from_: Seconds | None = None
    tag: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.from_ is not None and self.from_ < -9:
            raise UnusableInput("--from: expected seconds above -9")


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class _Options:
    """Options of one.

    Args:
        out: where to.
        steps: of them.
    """

    out: Folder
    shared: _Shared = field(default_factory=_Shared)
    noise: File | None = None
    tune: tuple[Pattern, ...] | None = None
    gap: tuple[float, float] | None = None
    masked: tuple[str, int] | None = None
    move: Annotated[str, Parameter(allow_leading_hyphen=True)] | None = None
    dimensions: Literal[2, 3] = 2
    steps: int = 60
    free_height: bool = False


def _run(*recordings: Recording, options: _Options) -> object:
    """Runs.

    More of it, on a line that is long enough to be broken where the terminal ends,
    after a break of its own.

    Args:
        recordings: recording folders.
    """
    return recordings, options


def _one(name: str, folder: Path | None = None, /, *, json: bool = False) -> object:
    """One.

    Args:
        name: a name.
        folder: a folder.
    """
    return name, folder, json


def _parsed(function, *words):
    app = new_app("run")
    app.default(function)
    try:
        return app(words)
    except CycloptsError as error:
        raise refusal(error, "run") from error


def test_words_become_what_the_annotations_say():
    words = "a --out o --from -2.5 --tune x* y --gap 1 2 --masked s 3 --dimensions 3 --free-height --noise=n.toml b"
    recordings, options = _parsed(_run, *words.split(), "--move", "-1,2", "--tag", "t")
    assert recordings == (Path("a"), Path("b"))
    assert options == _Options(
        out=Path("o"),
        shared=_Shared(from_=-2.5, tag=("t",)),
        noise=Path("n.toml"),
        tune=("x*", "y"),
        gap=(1.0, 2.0),
        masked=("s", 3),
        move="-1,2",
        dimensions=3,
        free_height=True,
    )


@pytest.mark.parametrize(
    ("function", "words", "message"),
    [
        (_run, "a", "no --out given; expected --out FOLDER, where to; see `run --help`"),
        (_run, "--out o", "no RECORDINGS given; expected recording folders; see"),
        (_run, "a --out --free-height", "--out: found nothing; expected --out FOLDER"),
        (_run, "a --out=", "--out '': expected FOLDER, found an empty name"),
        (_run, "a --out o --gap 1", "--gap: found 1; expected --gap with 2 values"),
        (_run, "a --out o --steps 1.5", "--steps 1.5: expected a whole number"),
        (_run, "a --out o --from soon", "--from soon: expected a number"),
        (_run, "a --out o --from -10", "--from: expected seconds above -9"),
        (_run, "a --out o --dimensions 4", "--dimensions 4: expected 2 or 3"),
        (_run, "a --out o --step 4", "no option --step (did you mean --steps?)"),
        (_run, "a --out o --free-height=maybe", "--free-height maybe: expected no value"),
        (_one, "a b c", "found 'c' beyond what it takes"),
    ],
)
def test_a_wrong_word_is_named(function, words, message):
    with pytest.raises(UnusableInput) as refused:
        _parsed(function, *words.split())
    assert message in str(refused.value)


def test_choices_are_those_of_the_library_which_help_does_not_import():
    assert get_args(options.Alignment) == get_args(pose_errors.Alignment)
