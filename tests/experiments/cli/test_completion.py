"""Completion scripts have every command and option, and bash accepts and uses its own."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from experiments.cli.arguments import arguments_of
from experiments.cli.main import FUNCTIONS, function_of
from tests.in_process import assert_refused, trackwright


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_script_names_every_command_and_option(shell):
    done = trackwright("completion", shell)
    assert (done.code, done.err) == (0, "")
    dash = "" if shell == "fish" else "--"
    for command in FUNCTIONS:
        assert command.split()[-1] in done.out
        for argument in arguments_of(function_of(command)):
            if not argument.positional:
                assert dash + argument.name[2:] in done.out


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("trackwright tra", {"track", "trackers"}),
        ("trackwright simulate li", {"line"}),
        ("trackwright track x --no-f", {"--no-figures"}),
        ("trackwright simulate line --situ", {"--situation"}),
        ("trackwright track x --tracker multi", {"multilateration"}),
        ("trackwright tunables uwb-", {"uwb-imu"}),
    ],
)
def test_bash_completes(line, expected):
    words = line.split(" ")
    script = trackwright("completion", "bash").out + (
        f"COMP_WORDS=({' '.join(repr(word) for word in words)}); COMP_CWORD={len(words) - 1}\n"
        '_trackwright; printf "%s\\n" "${COMPREPLY[@]}"\n'
    )
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert set(done.stdout.split()) == expected


def test_another_shell_is_refused():
    assert_refused(trackwright("completion", "csh"), "bash|zsh|fish csh: expected bash or zsh or fish")
