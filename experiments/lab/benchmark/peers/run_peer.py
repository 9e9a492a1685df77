"""One estimator on one recording: `python run_peer.py MODULE:FUNCTION FILE`.

FILE, a pickle of pairs of levels, m/s² per √Hz and m or rad, and of the problem of each tag, is replaced by one of
seconds and, for each tag, the paths by pair. The processor time is from the last pair, of functions that compile
from a second call.
"""

import os
import pickle
import sys
import time
import warnings
from functools import partial
from importlib import import_module
from pathlib import Path

from model import Problem

SMALL_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=3000000"
"""The options of XLA with which cuthbert and dynamax run fastest here."""


def main(adapter: str, file: str) -> None:
    """Run it, and replace the file."""
    assert "trackwright" not in sys.modules
    warnings.simplefilter("ignore")
    os.environ |= {"JAX_ENABLE_X64": "1", "XLA_FLAGS": SMALL_LOOPS}
    (*pairs, last), problems = pickle.loads(Path(file).read_bytes())
    module, _, name = adapter.partition(":")
    function, compiled, seconds, paths = getattr(import_module(module), name), name == "prepared", 0.0, []
    for problem in (Problem(**fields) for fields in problems):
        run = function(problem) if compiled else partial(function, problem)
        found = [run(*pair) for pair in (*pairs, *[last] * compiled)]
        began = time.process_time()
        paths.append([*found[: len(pairs)], run(*last)])
        seconds += time.process_time() - began
    Path(file).write_bytes(pickle.dumps((seconds, paths)))


if __name__ == "__main__":
    main(*sys.argv[1:])
