"""Mutations of single lines: which ones there are of an expression, and what is left alone."""

import os
import subprocess
import sys

import numpy as np
import pytest

from tests.mutation.calls import FOLDER
from tests.mutation.operators import mutations
from tests.mutation.selection import ROOT, Calls, concerned, declared_equivalent, drawn, found_again, numeric_modules


def _of(line, rest=""):
    """The mutated lines of one line in a function's body."""
    source = f"def f(x, y, t, n):\n    {line}\n{rest}"
    found = mutations("a.py", source)
    for mutation in found:
        compile(mutation.applied(source), "a.py", "exec")
    return {mutation.after.strip() for mutation in found}


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("return x + y", {"return x - y", "return x"}),
        ("return x * (y - t)", {"return x / (y - t)", "return x", "return x * (y + t)", "return x * (y)"}),
        ("return (x if n else y) / t", {"return (x if n else y) * t"}),
        ("return -x", {"return x"}),
        ("return ~x & y", {"return x & y", "return ~x | y"}),
        ("return not x or y", {"return x or y", "return not x and y"}),
        ("return x < y", {"return x <= y"}),
        ("return x if n == 3 else y", {"return x if n != 3 else y", "return x if n == 6 else y"}),
        ("return 0.5 * x", {"return 1.0 * x", "return 0.5 / x", "return 0.5"}),
        ("return x[1]", {"return x[0]", "return x[2]"}),
        ("return x[..., -1]", {"return x[..., -2]"}),
        ("return np.sqrt(x)", {"return x"}),
        ("return np.sum(x, axis=0)", {"return np.sum(x, axis=1)"}),
        ("return np.minimum(x, y)", {"return np.maximum(x, y)"}),
        ("return np.where(n, x, y)", {"return np.where(n, y, x)"}),
        ("return State(x, y)", {"return State(y, x)"}),
        ('return np.searchsorted(x, y, side="left")', {
            'return np.searchsorted(y, x, side="left")', 'return np.searchsorted(x, y, side="right")'}),
        ("x += y", {"x -= y"}),
        ("return y if 'σ + 1' else x - y", {"return y if 'σ + 1' else x + y", "return y if 'σ + 1' else x"}),
    ],
)  # fmt: skip
def test_the_mutations_of_an_expression(line, expected):
    assert _of(line) == expected


@pytest.mark.parametrize(
    "line",
    [
        '"""Of 2 + 2."""',
        'raise ValueError(f"found {x + 1}, expected {y - 1}")',
        "assert x < y",
        "if x < 0:\n        raise ValueError",
        "z: Array[1 + 2]",
        'size = field(default=2)',
    ],
)  # fmt: skip
def test_messages_checks_and_annotations_are_left_alone(line):
    assert _of(line) == set()


def test_defaults_constants_and_checking_functions_are_left_alone():
    source = "STEP = 2 * 0.5\n\nclass A:\n    size = 1 + 1\n\n\ndef f(x=0.5) -> 1 + 2:\n    pass\n\n\ndef _check(x):\n    y = x + 1\n"
    assert mutations("a.py", source) == []


def test_a_draw_depends_on_the_seed_alone_and_takes_each_line_once():
    first, again, other = drawn(ROOT, 300, 5), drawn(ROOT, 300, 5), drawn(ROOT, 300, 6)
    assert first == again
    assert first != other
    assert len({(m.file, m.line) for m in first}) == 300
    packages = {m.file.split("/")[0] for m in first}
    assert packages == {"trackers", "tuning", "sim", "experiments"}


def test_a_mutation_is_found_again_where_its_line_has_moved():
    mutation = drawn(ROOT, 1, 3)[0]
    lines = mutation.before.strip(), mutation.after.strip()
    assert found_again(ROOT, mutation.file, mutation.line, *lines) == mutation
    assert found_again(ROOT, mutation.file, mutation.line + 20, *lines).before.strip() == lines[0]
    with pytest.raises(ValueError, match="no longer there"):
        found_again(ROOT, mutation.file, mutation.line, "x = 1 + 1", "x = 1 - 1")


def test_every_mutation_of_the_library_is_python_and_changes_its_line_alone():
    random = np.random.default_rng(0)
    for file in numeric_modules(ROOT):
        source = (ROOT / file).read_text("utf-8")
        found = mutations(file, source)
        for k in random.permutation(len(found))[:3]:
            applied = found[k].applied(source)
            compile(applied, file, "exec")
            assert sum(a != b for a, b in zip(applied.split("\n"), source.split("\n"), strict=True)) == 1


def test_the_tests_that_call_a_function_are_its_own_first_and_then_the_quickest():
    source = "X = 1\n\n@cache\ndef f(x):\n    def g(y):\n        return y + 1\n    return g(x) + 2\n"
    f, g = ("trackers/a.py", 3), ("trackers/a.py", 5)
    called = {"tests/b.py": {f, g}, "tests/c.py": {f}, "tests/d.py": {f}, "tests/trackers/test_a.py": {f}}
    calls = Calls(called, {"tests/b.py": 1.0, "tests/c.py": 9.0, "tests/d.py": 2.0}, set())
    assert concerned(calls, "trackers/a.py", source, 6) == ["tests/b.py"]
    assert concerned(calls, "trackers/a.py", source, 7) == [
        "tests/trackers/test_a.py",
        "tests/b.py",
        "tests/d.py",
        "tests/c.py",
    ]
    # What runs when the module is imported may concern every test.
    assert (
        len(concerned(calls, "trackers/a.py", source, 1))
        == len(concerned(Calls(called, {}, {g}), "trackers/a.py", source, 6))
        == 4
    )
    assert concerned(calls, "trackers/b.py", source, 6) == []


def test_calls_are_recorded_by_test_file(tmp_path):
    file = "tests/trackers/core/data/test_chi_square.py"
    command = f"{sys.executable} -m pytest -q -n0 -p no:cacheprovider -p tests.mutation.calls {file}"
    subprocess.run(
        command.split(), cwd=ROOT, env={**os.environ, FOLDER: str(tmp_path)}, check=True, capture_output=True
    )
    calls = Calls.read(tmp_path)
    assert list(calls.by_file) == [file]
    assert {name for name, _ in calls.by_file[file]} >= {"trackers/core/data/consistency.py"}
    assert calls.seconds[file] > 0


def test_what_is_declared_equivalent_is_a_mutation_of_today_with_a_reason():
    for (file, before, after), reason in declared_equivalent().items():
        found = mutations(file, (ROOT / file).read_text("utf-8"))
        assert (before, after) in {(m.before.strip(), m.after.strip()) for m in found}, f"{file}: {before}"
        assert len(reason) > 20
