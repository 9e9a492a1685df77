"""The arguments of a command, declared by the signature of its function and explained by its docstring.

Parameters before `*` are positional arguments, those after it options: `free_height` is `--free-height`, `from_` is
`--from`. `tuple[T, ...]` takes all words up to the next option, `bool` none; of an option given twice the last
counts, lists are joined. The word for a value in help is that of
`Folder`, `Folders` and `File`, or of an `Annotated[T, "WORD"]`. The section `Args:` of the docstring has a line or more
on each. A parameter that is a dataclass of keyword-only fields stands for a group of options that commands share: its
fields are options, explained in its own docstring.
"""

from __future__ import annotations

import inspect
import re
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, Union, get_args, get_origin, get_type_hints

from trackers.core.errors import UnusableInput, near

Folder = Annotated[Path, "FOLDER"]
File = Annotated[Path, "FILE"]
Folders = Annotated[tuple[Path, ...], "FOLDER"]

FigureFormat = Literal["png", "pdf"]
"""The kinds of figures in files, by their endings."""

WORDS = {int: "N", float: "NUMBER", str: "TEXT", Path: "PATH"}
"""The words for values in help, by type."""

EXPECTED = {int: "a whole number", float: "a number"}


@dataclass(frozen=True)
class Argument:
    """A positional argument or an option of a command.

    `key`: the parameter of the function. `kinds`: the types of its values, or the choices of a `Literal`; none for a
    flag. `many`: any number of values of one kind. `word`: for the values in help. `about`: of the docstring.
    """

    key: str
    positional: bool
    kinds: tuple[Any, ...]
    many: bool
    word: str
    default: Any
    about: str

    @property
    def name(self) -> str:
        """How it is written: `--free-height`, or the word of a positional argument."""
        return self.word if self.positional else "--" + self.key.rstrip("_").replace("_", "-")

    @property
    def required(self) -> bool:
        """Whether it has to be given; a list of positional arguments may be empty, which commands refuse themselves."""
        return self.default is inspect.Parameter.empty and not (self.positional and self.many)

    @property
    def shown(self) -> str:
        """With its values, as `--tune PATTERN...`."""
        values = f"{self.word}..." if self.many else " ".join([self.word] * len(self.kinds))
        return values if self.positional else f"{self.name} {values}".rstrip()


def arguments_of(function: Callable[..., Any]) -> list[Argument]:
    """The arguments of a command, positional ones first."""
    hints, about = get_type_hints(function, include_extras=True), explanations(function)
    found = []
    for key, parameter in inspect.signature(function).parameters.items():
        if is_dataclass(hints[key]):
            found += arguments_of(hints[key])
            continue
        positional = parameter.kind is not inspect.Parameter.KEYWORD_ONLY
        kinds, many, word = _kinds(hints[key])
        found.append(Argument(key, positional, kinds, many, word, parameter.default, about.get(key, "")))
    return found


def _kinds(hint: Any, word: str = "") -> tuple[tuple[Any, ...], bool, str]:
    """The types of the values, whether there are any number of them, and the word for them."""
    if get_origin(hint) is Annotated:
        words = [x for x in hint.__metadata__ if isinstance(x, str)]
        return _kinds(get_args(hint)[0], word or "".join(words[:1]))
    if get_origin(hint) in (Union, types.UnionType):
        (inner,) = (x for x in get_args(hint) if x is not type(None))
        return _kinds(inner, word)
    if get_origin(hint) is Literal:
        return (hint,), False, word or "|".join(map(str, get_args(hint)))
    if get_origin(hint) is tuple:
        each = [_kinds(x, word) for x in get_args(hint) if x is not Ellipsis]
        shown = " ".join(dict.fromkeys(own for _, _, own in each))
        return tuple(kinds[0] for kinds, _, _ in each), Ellipsis in get_args(hint), shown
    return ((), False, "") if hint is bool else ((hint,), False, word or WORDS[hint])


def explanations(function: Callable[..., Any]) -> dict[str, str]:
    """The text on each parameter in the section `Args:` of the docstring."""
    found: dict[str, list[str]] = {}
    lines: list[str] = []
    for line in (inspect.getdoc(function) or "").partition("Args:\n")[2].splitlines():
        begun = re.match(r"\s+(\w+): (.*)", line)
        if begun and begun[1] in inspect.signature(function).parameters:
            lines = found.setdefault(begun[1], [])
            lines.append(begun[2])
        elif line.strip():
            lines.append(line.strip())
    return {key: " ".join(text) for key, text in found.items()}


def parse(function: Callable[..., Any], command: str, words: Sequence[str]) -> tuple[list[Any], dict[str, Any]]:
    """The positional and the keyword arguments for the function; raises UnusableInput, naming the one at fault."""
    arguments = arguments_of(function)
    options = {a.name: a for a in arguments if not a.positional}
    given: dict[str, list[str]] = {}
    loose: list[str] = []
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if word == "--":
            loose += rest
            break
        if not re.match(r"--\w|-[A-Za-z]", word):
            loose.append(word)
            continue
        name, equals, value = word.partition("=")
        option = options.get(name.replace("_", "-"))
        if option is None:
            _refuse_option(command, name, options)
        count = len(rest) if option.many else len(option.kinds)
        values = [value] if equals else []
        while not equals and rest and len(values) < count and not re.match(r"--\w|--$", rest[0]):
            values.append(rest.pop(0))
        if not option.many and len(values) != count:
            found = f"found '{value}'" if equals else "found nothing" if not values else f"found {' '.join(values)}"
            raise UnusableInput(f"{command}: {name}: {found}; expected {option.shown}{see(command)}")
        given[option.key] = [*given.get(option.key, ()), *values] if option.many else values
    positional = [a for a in arguments if a.positional]
    values, named = _placed(positional, command, loose), _named(options, command, given)
    for key, group in get_type_hints(function).items():
        if isinstance(group, type) and is_dataclass(group):
            named[key] = group(**{a.key: named.pop(a.key) for a in arguments_of(group)})
    return values, named


def _placed(positional: Sequence[Argument], command: str, words: list[str]) -> list[Any]:
    """The values of the positional arguments, of which the last may take many words."""
    found, left = [], list(words)
    for argument in positional:
        if argument.many:
            found.append(tuple(_value(argument, argument.kinds[0], command, word) for word in left))
            left = []
        elif left:
            found.append(_value(argument, argument.kinds[0], command, left.pop(0)))
        elif argument.required:
            raise UnusableInput(f"{command}: no {argument.word} given; expected {argument.about}{see(command)}")
        else:
            found.append(argument.default)
    if left:
        names = " ".join(a.shown for a in positional) or "none"
        raise UnusableInput(f"{command}: found {' '.join(map(repr, words))}; expected {names}{see(command)}")
    return found


def _named(options: Mapping[str, Argument], command: str, given: Mapping[str, list[str]]) -> dict[str, Any]:
    """The values of the options, with their defaults."""
    found = {}
    for option in options.values():
        if option.key not in given:
            if option.required:
                expected = f"{option.shown}, {option.about.rstrip('.')}"
                raise UnusableInput(f"{command}: no {option.name} given; expected {expected}{see(command)}")
            found[option.key] = option.default
        elif not option.kinds:
            found[option.key] = True
        else:
            words = given[option.key]
            kinds = option.kinds * len(words) if option.many else option.kinds
            values = tuple(_value(option, kind, command, word) for kind, word in zip(kinds, words, strict=True))
            found[option.key] = values if option.many or len(kinds) > 1 else values[0]
    return found


def _value(argument: Argument, kind: Any, command: str, word: str) -> Any:
    if get_origin(kind) is Literal:
        choices = {str(choice): choice for choice in get_args(kind)}
        if word not in choices:
            raise UnusableInput(
                f"{command}: {argument.name} {word}: expected {' or '.join(choices)}{near(word, choices)}"
            )
        return choices[word]
    if kind is Path and not word:
        raise UnusableInput(f"{command}: {argument.name} '': expected {argument.word}, found an empty name")
    try:
        return kind(word)
    except ValueError:
        raise UnusableInput(f"{command}: {argument.name} {word}: expected {EXPECTED[kind]}") from None


def _refuse_option(command: str, name: str, options: Mapping[str, Argument]) -> NoReturn:
    raise UnusableInput(f"{command}: no option {name}{near(name, options)}{see(command)}")


def see(command: str) -> str:
    """Where the arguments of a command are explained."""
    return f"; see `trackwright {command} --help`"
