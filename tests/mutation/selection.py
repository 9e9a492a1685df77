"""The modules that are mutated, the lines changed since a commit, and the tests that call a function."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import tomllib
from dataclasses import dataclass
from pathlib import Path
from random import Random

from tests.mutation.calls import AT_IMPORT
from tests.mutation.operators import Mutation, mutations

ROOT = Path(__file__).parents[2]
PACKAGES = ("trackers", "tuning", "sim", "experiments")
OF_TEXT = ("tests/mutation", "tests/test_docs.py", "tests/test_layout.py")
"""Tests of pages and source text, which no figure depends on."""

NOT_NUMERIC = (
    "trackers/conformance",
    "trackers/recordings/checks",
    "trackers/recordings/rig_file.py",
    "trackers/recordings/table_file.py",
    "tuning/checkpoint.py",
    "tuning/tuned_file.py",
    # The laboratory: what it prints is compared with committed pages by its own commands, not by tests.
    "experiments/lab/bench",
    "experiments/lab/papers",
    "experiments/lab/validation",
)
"""Files, messages and the laboratory: no figure of the product depends on them."""


def numeric_modules(root: Path) -> list[str]:
    """The files of the product that import numpy or jax, relative to the root."""
    files = (path for package in PACKAGES for path in sorted((root / package).rglob("*.py")))
    names = [(path.relative_to(root).as_posix(), path.read_text("utf-8")) for path in files]
    numeric = re.compile(r"^import (numpy|jax)\b", re.M)
    return [name for name, text in names if numeric.search(text) and not name.startswith(NOT_NUMERIC)]


def drawn(root: Path, count: int, seed: int, since: str | None = None) -> list[Mutation]:
    """`count` mutations on as many lines, each line as likely as any other; with `since` on lines changed since then."""
    changed = None if since is None else changed_lines(root, since)
    lines: dict[tuple[str, int], list[Mutation]] = {}
    for file in numeric_modules(root):
        for mutation in mutations(file, (root / file).read_text("utf-8")):
            if changed is None or mutation.line in changed.get(file, ()):
                lines.setdefault((file, mutation.line), []).append(mutation)
    random = Random(seed)
    chosen = random.sample(sorted(lines), min(count, len(lines)))
    return [random.choice(lines[place]) for place in chosen]


def found_again(root: Path, file: str, line: int, before: str, after: str) -> Mutation:
    """A mutation by its stripped lines, the nearest to a line; raises ValueError where the line is no longer there."""
    every = mutations(file, (root / file).read_text("utf-8"))
    same = [m for m in every if (m.before.strip(), m.after.strip()) == (before, after)]
    if not same:
        raise ValueError(f"{file}: the line '{before}' is no longer there; draw again")
    return min(same, key=lambda m: abs(m.line - line))


def changed_lines(root: Path, since: str) -> dict[str, set[int]]:
    """The numbers of the lines that differ from those of a commit, by file."""
    command = ["git", "diff", "--unified=0", since, "--", *PACKAGES]
    diff = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True).stdout
    changed: dict[str, set[int]] = {}
    file = ""
    for line in diff.splitlines():
        if line.startswith("+++ "):
            file = line.removeprefix("+++ b/")
        elif match := re.match(r"@@ -\S+ \+(\d+)(?:,(\d+))? @@", line):
            first, number = int(match[1]), int(match[2] or 1)
            changed.setdefault(file, set()).update(range(first, first + number))
    return changed


def declared_equivalent() -> dict[tuple[str, str, str], str]:
    """The reasons why mutations change nothing that can be observed, by file and stripped lines before and after."""
    table = tomllib.loads((Path(__file__).parent / "equivalent.toml").read_text("utf-8"))
    return {(m["file"], m["before"], m["after"]): m["reason"] for m in table.get("mutation", [])}


def reason_of(mutation: Mutation, declared: dict[tuple[str, str, str], str]) -> str | None:
    """The reason why a mutation is equivalent; None for one that is not declared so."""
    return declared.get((mutation.file, mutation.before.strip(), mutation.after.strip()))


@dataclass(frozen=True)
class Calls:
    """`by_file`: the functions that each test file calls, by file and first line; `seconds`: how long the file runs.

    `at_import`: the functions that were called before any test.
    """

    by_file: dict[str, set[tuple[str, int]]]
    seconds: dict[str, float]
    at_import: set[tuple[str, int]]

    @classmethod
    def read(cls, folder: Path) -> Calls:
        """What the processes of a run with the plugin `tests.mutation.calls` wrote into a folder."""
        by_file: dict[str, set[tuple[str, int]]] = {}
        seconds: dict[str, float] = {}
        for path in folder.glob("*.json"):
            document = json.loads(path.read_text("utf-8"))
            for file, called in document["calls"].items():
                by_file.setdefault(file, set()).update((name, line) for name, line in called)
            for file, value in document["seconds"].items():
                seconds[file] = seconds.get(file, 0.0) + value
        return cls(by_file, seconds, by_file.pop(AT_IMPORT, set()))


def concerned(calls: Calls, file: str, source: str, line: int) -> list[str]:
    """The test files that call the function around a line: the one that mirrors its file first, then the quickest.

    Of a line that is run when its module is imported: all test files.
    """
    around = {(file, first) for first in functions_around(source, line)}
    found = [
        name for name, called in calls.by_file.items() if around & called or not around or around & calls.at_import
    ]
    path = Path(file)
    own = (Path("tests") / path.with_name(f"test_{path.name}")).as_posix()
    found = [name for name in found if not name.startswith(OF_TEXT)]
    return sorted(found, key=lambda name: (name != own, calls.seconds.get(name, 0.0)))


def functions_around(source: str, line: int) -> list[int]:
    """The first line, as Python counts it, of the innermost function around a line; empty outside of functions."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef)
    found = [node for node in ast.walk(ast.parse(source)) if isinstance(node, kinds)]
    firsts = {min([node.lineno, *(d.lineno for d in node.decorator_list)]): node for node in found}
    return sorted(first for first, node in firsts.items() if first <= line <= (node.end_lineno or line))[-1:]
