"""The arguments of a command are read as its function's signature declares them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest

from experiments.cli.arguments import File, Folder, Folders, arguments_of, parse
from experiments.cli.help_text import command_help
from trackers.core.errors import UnusableInput


def _run(
    recordings: Folders,
    *,
    out: Folder,
    from_: Annotated[float | None, "S"] = None,
    noise: File | None = None,
    tune: tuple[str, ...] | None = None,
    gap: tuple[float, float] | None = None,
    masked: tuple[str, int] | None = None,
    dimensions: Literal[2, 3] = 2,
    steps: int = 60,
    free_height: bool = False,
) -> None:
    """Runs.

    More of it.

    Args:
        recordings: recording folders.
        out: where to.
        from_: seconds,
            on two lines.
        steps: of them.
    """


def _one(name: str, folder: Folder | None = None, *, json: bool = False) -> None:
    """One.

    Args:
        name: a name.
    """


def test_words_become_what_the_annotations_say():
    words = "a b --out o --from -2.5 --tune x* y --gap 1 2 --masked s 3 --dimensions 3 --free-height --noise=n.toml c"
    positional, named = parse(_run, "run", words.split()[:-1])
    assert positional == [(Path("a"), Path("b"))]
    assert named == {
        "out": Path("o"),
        "from_": -2.5,
        "noise": Path("n.toml"),
        "tune": ("x*", "y"),
        "gap": (1.0, 2.0),
        "masked": ("s", 3),
        "dimensions": 3,
        "steps": 60,
        "free_height": True,
    }


def test_positional_words_may_come_after_options_and_a_dash_dash_ends_these():
    assert parse(_run, "run", ["--out", "o", "a"])[0] == [(Path("a"),)]
    positional, named = parse(_run, "run", ["--out", "o", "--tune", "x", "y", "--", "--a"])
    assert (positional, named["tune"]) == ([(Path("--a"),)], ("x", "y"))
    assert parse(_run, "run", ["--out", "o", "--tune", "x", "--tune", "y"])[1]["tune"] == ("x", "y")
    assert parse(_run, "run", ["--out", "o", "--out", "p"])[1]["out"] == Path("p")
    assert parse(_run, "run", ["--out", "o", "--free_height"])[1]["free_height"] is True


def test_an_optional_positional_argument_has_its_default():
    assert parse(_one, "one", ["n"]) == (["n", None], {"json": False})
    assert parse(_one, "one", ["n", "f", "--json"]) == (["n", Path("f")], {"json": True})


@pytest.mark.parametrize(
    ("function", "words", "message"),
    [
        (_run, "a", "no --out given; expected --out FOLDER, where to"),
        (_run, "a --out", "--out: found nothing; expected --out FOLDER"),
        (_run, "a --out o --gap 1", "--gap: found 1; expected --gap NUMBER NUMBER"),
        (_run, "a --out o --steps 1.5", "--steps 1.5: expected a whole number"),
        (_run, "a --out o --from soon", "--from soon: expected a number"),
        (_run, "a --out o --dimensions 4", "--dimensions 4: expected 2 or 3"),
        (_run, "a --out o --step 4", "no option --step (did you mean --steps?)"),
        (_run, "a --out o --free-height=yes", "--free-height: found 'yes'; expected --free-height"),
        (_run, "a -x --out p", "no option -x"),
        (_one, "", "no TEXT given; expected a name"),
        (_one, "a b c", "found 'a' 'b' 'c'; expected TEXT FOLDER"),
    ],
)
def test_a_wrong_word_is_named(function, words, message):
    with pytest.raises(UnusableInput) as refusal:
        parse(function, "run", words.split())
    assert message in str(refusal.value)


def test_help_shows_what_has_to_be_given_and_all_defaults():
    text = command_help(_run, "trackwright run")
    assert text.startswith("usage: trackwright run FOLDER... --out FOLDER [options]\n\nRuns.\n\nMore of it.\n")
    assert "  --from S              seconds, on two lines\n" in text
    assert "of them (default: 60)" in text
    assert "where to (required)" in text
    assert command_help(_one, "one").startswith("usage: one TEXT [FOLDER] [options]")
    assert [a.name for a in arguments_of(_one)] == ["TEXT", "FOLDER", "--json"]


@dataclass(frozen=True, kw_only=True)
class _Shared:
    """Options of several commands.

    Args:
        from_: seconds.
        tag: these tags alone.
    """

    from_: Annotated[float | None, "S"] = None
    tag: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.from_ is not None and self.from_ < 0:
            raise UnusableInput("--from: expected seconds above zero")


def _grouped(name: str, *, first: int = 1, shared: _Shared, last: bool = False) -> None:
    """Runs.

    Args:
        name: a name.
        first: a number.
        last: a flag.
    """


def test_a_group_of_options_is_one_argument_of_the_function():
    assert [a.name for a in arguments_of(_grouped)] == ["TEXT", "--first", "--from", "--tag", "--last"]
    given = {"first": 1, "shared": _Shared(from_=2.0, tag=("a", "b")), "last": False}
    assert parse(_grouped, "run", ["n", "--from", "2", "--tag", "a", "b"]) == (["n"], given)
    assert parse(_grouped, "run", ["n"])[1]["shared"] == _Shared()
    assert "  --tag TEXT...         these tags alone\n  --last" in command_help(_grouped, "trackwright run")
    with pytest.raises(UnusableInput, match="--from"):
        parse(_grouped, "run", ["n", "--from", "-2"])
