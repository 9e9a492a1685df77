"""One estimator on one recording: `python run_peer.py MODULE:FUNCTION PROBLEMS.npz ESTIMATES.npz LEVELS…`.

LEVELS are pairs such as 0.3,0.2: m/s² per √Hz, and m or rad. Of each pair the estimates of every tag are kept; of the
last one the processor time, of functions that compile that of a second call.
"""

from __future__ import annotations

import sys
import time
import warnings
from importlib import import_module
from typing import Any

import numpy as np
from model import Problem

FIELDS = ("times", "values", "seen", "geometry")


def main(function: str, source: str, target: str, *levels: str) -> None:
    """Run it, and keep `positions_L_K` and `covariances_L_K` of level L and tag K, and `seconds`."""
    assert "trackwright" not in sys.modules
    warnings.simplefilter("ignore")
    module, _, name = function.partition(":")
    if module in ("with_cuthbert", "with_dynamax"):
        import jax

        jax.config.update("jax_enable_x64", True)
    made, kept = getattr(import_module(module), name), dict[str, Any]()
    with np.load(source) as arrays:
        count = sum(key.startswith("times") for key in arrays)
        problems = [
            Problem(str(arrays["kind"]), *(arrays[f"{f}_{k}"] for f in FIELDS), float(arrays[f"height_{k}"]),
                    tuple(arrays["prior"].tolist()))
            for k in range(count)
        ]  # fmt: skip
    seconds = 0.0
    for k, problem in enumerate(problems):
        run = made(problem) if name == "prepared" else lambda *pair, problem=problem: made(problem, *pair)
        for number, pair in enumerate(levels):
            numbers = tuple(map(float, pair.split(",")))
            if number == len(levels) - 1 and name == "prepared":
                run(*numbers)
            began = time.process_time()
            kept[f"positions_{number}_{k}"], covariances = run(*numbers)
            seconds += (time.process_time() - began) * (number == len(levels) - 1)
            if covariances is not None:
                kept[f"covariances_{number}_{k}"] = covariances
    np.savez(target, seconds=seconds, **kept)


if __name__ == "__main__":
    main(*sys.argv[1:])
