"""One estimator on one recording: `python run_peer.py MODULE:FUNCTION PROBLEMS.npz ESTIMATES.npz LEVELS…`.

LEVELS are pairs such as 0.3,0.2: m/s² per √Hz, and m or rad. The processor time is that of the last pair, of functions
that compile that of a second call.
"""

import os
import sys
import time
import warnings
from importlib import import_module
from typing import Any

import numpy as np
from model import Problem


def main(function: str, source: str, target: str, *levels: str) -> None:
    """Run it, and keep `positions_L_K` and `covariances_L_K` of level L and tag K, and `seconds`."""
    assert "trackwright" not in sys.modules
    warnings.simplefilter("ignore")
    module, _, name = function.partition(":")
    os.environ["JAX_ENABLE_X64"] = "1"
    made, kept = getattr(import_module(module), name), dict[str, Any]()
    with np.load(source) as arrays:
        kind, prior, seconds = str(arrays["kind"]), tuple(arrays["prior"].tolist()), 0.0
        tags = range(sum(key.startswith("times") for key in arrays))
        fields = ("times", "values", "seen", "geometry", "height")
        problems = [Problem(kind, *(arrays[f"{f}_{k}"] for f in fields), prior) for k in tags]
    for k, problem in enumerate(problems):
        run = made(problem) if name == "prepared" else lambda *pair, problem=problem: made(problem, *pair)
        for number, pair in enumerate(levels):
            numbers, last = tuple(map(float, pair.split(","))), number == len(levels) - 1
            if last and name == "prepared":
                run(*numbers)
            began = time.process_time()
            kept[f"positions_{number}_{k}"], covariances = run(*numbers)
            seconds += (time.process_time() - began) * last
            if covariances is not None:
                kept[f"covariances_{number}_{k}"] = covariances
    np.savez(target, seconds=seconds, **kept)


if __name__ == "__main__":
    main(*sys.argv[1:])
