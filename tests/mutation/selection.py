"""The modules that are mutated, the lines changed since a commit, and the tests that concern a module."""

from __future__ import annotations

import ast
import re
import subprocess
import tomllib
from functools import cache
from os.path import commonpath
from pathlib import Path
from random import Random

from tests.mutation.operators import Mutation, mutations

ROOT = Path(__file__).parents[2]
PACKAGES = ("trackers", "tuning", "sim", "experiments")
PUBLIC = {"trackwright", "trackers", "tuning", "sim"}
OF_TEXT = ("tests/mutation", "tests/test_docs.py", "tests/test_layout.py")
"""Tests of pages and source text, which no figure depends on."""

NOT_NUMERIC = (
    "trackers/core/checks.py",
    "trackers/recordings/checks",
    "trackers/recordings/rig_file.py",
    "trackers/recordings/table_file.py",
    "tuning/checkpoint.py",
    "tuning/tuned_file.py",
    # The laboratory: what it prints is compared with committed pages by its own commands, not by tests.
    "experiments/bench",
    "experiments/papers",
    "experiments/questions",
    "experiments/validation",
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


def stages(root: Path, file: str) -> list[list[str]]:
    """The test files for a module, in three stages: its own, those of its folder and its importers, all others.

    Within a stage those come first whose imports lead to the module by the fewest steps, then those in folders near it.
    """
    path = Path(file)
    own = (Path("tests") / path.with_name(f"test_{path.name}")).as_posix()
    steps = _steps_to(root, file)
    every = [name for name in steps if Path(name).name.startswith("test_")]
    every = [name for name in every if not name.startswith(OF_TEXT)]

    def distance(name: str) -> tuple[bool, int, int]:
        shared = commonpath([Path(name).parent, Path(own).parent])
        # The command line is slow, and reaches every module.
        return name.startswith("tests/experiments"), steps[name], -len(Path(shared).parts)

    every.sort(key=distance)
    folder = {name for name in every if Path(name).parent == Path(own).parent}
    near = [name for name in every if name != own and (steps[name] == 1 or name in folder)]
    rest = [name for name in every if name != own and name not in near]
    return [stage for stage in ([own] if own in every else [], near, rest) if stage]


def _steps_to(root: Path, file: str) -> dict[str, int]:
    """The number of imports from each file under tests to a file, fewest first; those without a way to it last."""
    imports = _imports(root)
    steps, level = {file: 0}, [file]
    while level:
        level = [name for name, imported in imports.items() if name not in steps and imported & set(level)]
        steps |= dict.fromkeys(level, max(steps.values()) + 1)
    far = max(steps.values()) + 1
    tests = sorted(name for name in imports if name.startswith("tests/"))
    # By a package's list of public names a test may reach any module.
    steps |= {name: min(2, steps.get(name, far)) for name in tests if PUBLIC & imports[name]}
    return dict(sorted(((name, steps.get(name, far)) for name in tests), key=lambda item: item[1]))


@cache
def _imports(root: Path) -> dict[str, set[str]]:
    """The files that each file imports, and `PUBLIC` packages, whose lists of names are no step on the way."""
    files = [p.relative_to(root) for folder in (*PACKAGES, "tests") for p in (root / folder).rglob("*.py")]
    modules = {".".join(p.with_suffix("").parts): p.as_posix() for p in files if p.name != "__init__.py"}
    modules |= {package: package for package in PUBLIC}
    return {p.as_posix(): {modules[m] for m in _imported(root / p) if m in modules} for p in files}


def _imported(path: Path) -> set[str]:
    tree = ast.parse(path.read_text("utf-8"))
    found = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    sources = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    return found | {node.module or "" for node in sources} | {f"{n.module}.{a.name}" for n in sources for a in n.names}
