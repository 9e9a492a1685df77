"""`trackwright verify`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from experiments.cli.console import progress
from experiments.verify import exact_checks, particle_checks
from experiments.verify.findings import Finding, table

CHECKS: tuple[Callable[[], list[Finding]], ...] = (
    exact_checks.kalman_findings,
    exact_checks.chain_findings,
    exact_checks.grid_findings,
    partial(particle_checks.corridor_findings, 25),
    partial(particle_checks.corridor_findings, 100),
    particle_checks.corridor_pairs_findings,
    particle_checks.halt_findings,
    particle_checks.corridor_order_findings,
    particle_checks.halt_order_findings,
    particle_checks.corridor_wrong_findings,
    particle_checks.halt_wrong_findings,
)
"""Every gradient against its oracle, and those that must be found wrong."""


def verify() -> int:
    """Hold every gradient against an oracle that shares no code with it: prints a table; exit 1 where one is off.

    Kalman filter: the density of all fixes at once. Hidden Markov chain: all sequences of states. Grid filter and
    particles: quadrature in double precision, of a corridor whose walls kill and of a halt on a line. Estimates that
    draw random numbers are made with 400 keys, and their mean may be 4 standard errors off. Two estimators that are
    known to be wrong must be found wrong.
    """
    findings: list[Finding] = []
    with progress("verifying", len(CHECKS)) as advance:
        for check in CHECKS:
            findings += check()
            advance(1)
    print(table(findings))
    return 0 if all(f.passed for f in findings) else 1
