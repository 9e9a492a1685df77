"""`trackwright verify`."""

from __future__ import annotations

from dataclasses import asdict


def verify(*, json: bool = False) -> int:
    """Check every gradient against an oracle; exit 1 if one fails.

    Oracles share no code with the gradients: the joint density of all fixes for the Kalman filter; enumeration of all
    state sequences for the hidden Markov chain; quadrature in double precision for grid and particle filters, in a
    corridor whose walls kill particles and at a halt on a line. Random estimates use 400 keys, and their mean may be 4
    standard errors off. Two estimators that are known to be biased must fail.

    Args:
        json: print JSON instead of a table.
    """
    from trackwright.experiments.cli.runtime import keep_programs
    from trackwright.experiments.lab.verify.checks import CHECKS, table
    from trackwright.experiments.text.terminal import progress
    from trackwright.trackers.recordings.atomic import json_text

    keep_programs()
    results = []
    with progress("verify", len(CHECKS)) as advance:
        for check in CHECKS:
            results += check()
            advance(1)
    print(json_text([asdict(result) | {"passed": result.passed} for result in results]) if json else table(results))
    return 0 if all(r.passed for r in results) else 1
