"""The command line: `trackwright COMMAND …`, also `python -m experiments`."""

from __future__ import annotations

import os
import sys
from typing import Any

from experiments.cli.runtime import set_flags


def main() -> None:
    """Run one command. Exit code 0, 1 (a check failed) or 2 (unusable input, one line on standard error)."""
    try:
        code = _run()
        sys.stdout.flush()
    except KeyboardInterrupt:
        print("trackwright: interrupted; files already written are complete", file=sys.stderr)
        code = 130
    except BrokenPipeError:
        # The reader closed the pipe: discard the rest of the output.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 141
    sys.exit(code)


def _run() -> int:
    set_flags()
    # Imported here because jax reads its flags when it is first imported.
    import tyro

    from experiments.cli import (
        check,
        evaluate,
        report,
        simulate,
        study,
        sweep,
        track,
        truth,
        tune,
        verify,
    )
    from trackers.core.errors import UnusableInput

    commands: dict[str, Any] = {
        **simulate.COMMANDS,
        "check": check.check,
        "track": track.track,
        "evaluate": evaluate.evaluate_tracks,
        "tune": tune.tune,
        "sweep": sweep.sweep,
        "study": study.study,
        "report": report.report,
        "truth": truth.truth,
        "verify": verify.verify,
    }
    try:
        code: int | None = tyro.extras.subcommand_cli_from_dict(
            commands, prog="trackwright", description="How accurate is this tracker, and with which noise levels?"
        )
    except UnusableInput as problem:
        print(f"trackwright: {problem}", file=sys.stderr)
        code = 2
    return code or 0
