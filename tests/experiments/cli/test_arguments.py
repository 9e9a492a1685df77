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


def test_a_dash_dash_ends_options_and_an_underscore_is_a_dash():
    recordings, options = _parsed(_run, "--out", "o", "--free_height", "--", "--a")
    assert (recordings, options.free_height) == ((Path("--a"),), True)


def test_of_an_option_given_twice_the_last_counts_and_lists_are_joined():
    _, options = _parsed(
        _run, "a", "--out", "o", "--out", "p", "--tune", "x", "--tune", "y", "--steps", "1", "--steps=2"
    )
    assert (options.out, options.tune, options.steps) == (Path("p"), ("x", "y"), 2)


def test_an_optional_positional_argument_has_its_default():
    assert _parsed(_one, "n") == ("n", None, False)
    assert _parsed(_one, "n", "f", "--json") == ("n", Path("f"), True)


@pytest.mark.parametrize(
    ("function", "words", "message"),
    [
        (_run, "a", "no --out given; expected --out FOLDER, where to; see `run --help`"),
        (_run, "--out o", "no RECORDINGS given; expected recording folders; see"),
        (_run, "a --out", "--out: found nothing; expected --out FOLDER"),
        (_run, "a --out --free-height", "--out: found nothing; expected --out FOLDER"),
        (_run, "a --out=", "--out '': expected FOLDER, found an empty name"),
        (_run, "a --out o --tag", "--tag: found nothing; expected --tag VALUE"),
        (_run, "a --out o --gap 1", "--gap: found 1; expected --gap with 2 values"),
        (_run, "a --out o --steps 1.5", "--steps 1.5: expected a whole number"),
        (_run, "a --out o --steps 0x1", "--steps 0x1: expected a whole number"),
        (_run, "a --out o --from soon", "--from soon: expected a number"),
        (_run, "a --out o --from -10", "--from: expected seconds above -9"),
        (_run, "a --out o --dimensions 4", "--dimensions 4: expected 2 or 3"),
        (_run, "a --out o --dimensions", "--dimensions: found nothing; expected --dimensions 2|3"),
        (_run, "a --out o --step 4", "no option --step (did you mean --steps?)"),
        (_run, "a --out o --shared.tag t", "no option --shared.tag"),
        (_run, "a --out o --no-free-height", "no option --no-free-height (did you mean --free-height?)"),
        (_run, "a --out o --free-height=maybe", "--free-height maybe: expected no value"),
        (_run, "a -x --out p", "no option -x"),
        (_one, "", "no NAME given; expected a name"),
        (_one, "a b c", "found 'c' beyond what it takes"),
    ],
)
def test_a_wrong_word_is_named(function, words, message):
    with pytest.raises(UnusableInput) as refused:
        _parsed(function, *words.split())
    assert message in str(refused.value)


def test_help_shows_what_has_to_be_given_and_all_defaults(capsys):
    _parsed(_run, "--help")
    text = capsys.readouterr().out
    assert text.startswith("usage: run --out FOLDER [OPTIONS] RECORDINGS...\n\nRuns.\n\nMore of it, on a line")
    assert "terminal ends, after" in " ".join(text.split())
    assert "  --from S              seconds, on two lines\n" in text
    assert "  --tune PATTERN...\n" in text
    assert "of them (default: 60)" in text
    assert "where to (required)" in text
    assert max(map(len, text.splitlines())) <= 80
    assert "  --tag STR...          these tags alone\n" in text


def test_choices_are_those_of_the_library_which_help_does_not_import():
    assert get_args(options.Alignment) == get_args(pose_errors.Alignment)
