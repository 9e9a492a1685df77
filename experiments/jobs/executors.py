"""Where independent parts of a command run: threads of this process, or the workers of a Dask cluster.

Both are `concurrent.futures.Executor`s. A part is a function and its arguments; what a part returns does not depend on
where it runs: a worker computes only with the caller's versions, XLA flags and number format.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import os
import pickle
import platform
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

from trackwright.experiments.text.terminal import notice
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.programs import keep

# jax and the modules that import it are imported in functions: in a worker after the XLA flags are set.

AT_ONCE = 256
"""Parts given to a cluster at once, at least: finished ones are held in memory until the caller has stored them."""

LEAVE_SIGINT = "import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n"
"""Run by local workers, which the caller ends: Ctrl-C on a terminal reaches them, too."""

CONNECT_S = 10  # seconds to wait for a scheduler
SILENT_S = 60
"""Seconds without a sign of life after which a local worker hangs: it is ended, and its part runs elsewhere."""

PACKAGES, SOURCES = ("trackwright", "jax", "jaxlib", "numpy"), ("trackers", "sim", "tuning", "experiments")


def environment() -> dict[str, Any]:
    """What the bits of a result depend on beside its arguments; the number format is the caller's for each part."""
    import jax

    flags, processor = os.environ.get("XLA_FLAGS", ""), (jax.devices()[0].device_kind, _vector_instructions())
    settled = {"sources": _sources(), "XLA flags": flags, "processor": processor}
    return {name: version(name) for name in PACKAGES} | settled | {"x64": bool(jax.config.jax_enable_x64)}  # type: ignore[attr-defined]


@functools.cache
def _sources() -> str:
    """A digest of the package's source files: two checkouts of one version may differ."""
    root, digest = Path(__file__).parents[2], hashlib.sha256()
    for path in sorted(path for name in SOURCES for path in (root / name).rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def _vector_instructions() -> str:
    """The processor's widest vector instructions: NumPy has other sines and logarithms for others, with other bits."""
    with suppress(OSError):
        flags = Path("/proc/cpuinfo").read_text("utf-8").split()
        return next((name for name in ("avx512f", "avx2", "avx") if name in flags), platform.machine())
    return platform.machine()


def require_same(expected: Mapping[str, Any], actual: Any, worker: str) -> None:
    """Refuse a worker whose environment differs from the caller's."""
    if isinstance(actual, BaseException):
        why = f"{type(actual).__name__}: {actual}"
        raise UnusableInput(f"{worker}: cannot import trackwright ({why}); install the caller's packages there")
    for key in expected.keys() - {"x64"}:
        if actual.get(key) != expected[key]:
            here = f"expected as here: {expected[key] or 'none'}; the bits would differ"
            raise UnusableInput(f"{worker}: {key}: {actual.get(key) or 'none'}; {here}; install the caller's packages")


class Threads(ThreadPoolExecutor):
    """As many threads of this process as the host computes in parallel; `at_once`: parts given to them at a time."""

    def __init__(self) -> None:
        from trackwright.trackers.core.run.chunks import n_workers

        super().__init__(n_workers())
        self.at_once = 2 * n_workers()


@contextmanager
def cluster_executor(cluster: str) -> Iterator[WorkerExecutor]:
    """The workers of a Dask cluster, `local:N` or those of the scheduler at `tcp://HOST:PORT`.

    Raises UnusableInput for another text, where no scheduler answers, for workers with other versions, and where the
    cluster is lost.
    """
    local = re.fullmatch(r"local:([1-9]\d{0,3})", cluster)
    if not local and not re.fullmatch(r"[a-z]+://\S+", cluster):
        raise UnusableInput(f"--cluster {cluster}: expected local:N, as local:4, or an address, as tcp://HOST:8786")
    try:
        import distributed
    except ImportError as error:
        fix = "install the extra: pip install trackwright[cluster]"
        raise UnusableInput(f"--cluster: the package 'distributed' is not installed; {fix}") from error
    # The deaths and reconnections that Dask reports are handled: their parts run elsewhere.
    for name in ("distributed", "distributed.client", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    lost = CancelledError, distributed.CancelledError, distributed.comm.CommClosedError, distributed.KilledWorker
    expected = environment()
    try:
        with _client(distributed, cluster, int(local[1]) if local else None) as client:
            if not client.nthreads():
                notice(f"{cluster}: no worker yet; waiting for the first one")
            client.wait_for_workers(1)
            for address, actual in client.run(_prepared, expected["XLA flags"], on_error="return").items():
                require_same(expected, actual, f"worker {address}")
            workers = len(client.nthreads())
            yield WorkerExecutor(client.get_executor(pure=False), expected, max(AT_ONCE, workers + workers // 4))
    except lost as error:
        why = f"the scheduler was lost, or workers ended while they computed ({type(error).__name__})"
        raise UnusableInput(f"--cluster {cluster}: {why}; see their logs, then run the command again") from error


@contextmanager
def _client(distributed: Any, cluster: str, processes: int | None) -> Iterator[Any]:
    """A client of a scheduler, or of worker processes of its own."""
    if processes is None:
        try:
            client = distributed.Client(cluster, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            fix = "expected one at this address; start one with `dask scheduler`"
            raise UnusableInput(f"--cluster {cluster}: no scheduler answers within {CONNECT_S} s; {fix}") from error
        with client:
            yield client
        return
    # One thread a process computes one part at a time; memory is limited by the system alone, as it is for threads.
    workers = {"n_workers": processes, "threads_per_worker": 1, "memory_limit": 0, "preload": LEAVE_SIGINT}
    others = {"dashboard_address": ":0", "silence_logs": logging.CRITICAL, "scheduler_kwargs": {"worker_ttl": SILENT_S}}
    with (
        distributed.LocalCluster(**workers, **others) as started,
        distributed.Client(started, set_as_default=False) as client,
    ):
        yield client


class WorkerExecutor(Executor):
    """An executor of other processes that computes only where the environment is `expected`."""

    def __init__(self, executor: Executor, expected: Mapping[str, Any], at_once: int = AT_ONCE) -> None:
        self.executor, self.expected, self.at_once = executor, dict(expected), at_once

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        # As bytes, so that the worker unpickles nothing that imports jax before the flags are set.
        return self.executor.submit(computed, self.expected, pickle.dumps((function, args, kwargs)))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self.executor.shutdown(wait=wait, cancel_futures=cancel_futures)


def computed(expected: Mapping[str, Any], call: bytes) -> Any:
    """In a worker: the result of a pickled call; raises UnusableInput where the environment differs."""
    require_same(expected, _prepared(expected["XLA flags"]), f"worker on {platform.node()}")
    import jax

    with jax.enable_x64(expected["x64"]):
        function, args, kwargs = pickle.loads(call)
        return function(*args, **kwargs)


def _prepared(flags: str) -> dict[str, Any]:
    """In a worker: its environment, with these XLA flags where jax is not imported yet; freed memory is kept."""
    keep()
    if "jax" not in sys.modules:
        os.environ["XLA_FLAGS"] = flags
    return environment()
