"""`trackwright demo`."""

from __future__ import annotations


def demo() -> int:
    """Simulate, check, track, evaluate and tune: a tour in out/demo.

    Prints every command before it is run, and a summary. It takes some minutes; an out/demo of before is replaced.
    """
    from experiments.validation.demo import main

    main()
    return 0
