"""A network that is down for a while between a command, its scheduler and its workers: two hosts on one machine."""

from __future__ import annotations

import ipaddress
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.faults.jobs import begun, reference, running
from tests.faults.seen import Seen, UntriedError
from tests.faults.workers import dask_scheduler, dask_workers


class Host(NamedTuple):
    """Another host on this machine: a network namespace whose only link ends here, at the address `here`."""

    name: str
    here: str

    @property
    def words(self) -> tuple[str, ...]:
        """What goes before a command that runs there."""
        return ("ip", "netns", "exec", self.name)

    def cut(self, seconds: float) -> None:
        """Takes the link down for so long."""
        _ip("-n", self.name, "link", "set", "there", "down")
        time.sleep(seconds)
        _ip("-n", self.name, "link", "set", "there", "up")


def _ip(*words: str) -> None:
    done = subprocess.run(["ip", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise UntriedError(f"ip {' '.join(words)}: {done.stderr.strip()}")


@contextmanager
def other_host() -> Iterator[Host]:
    """Another host; raises UntriedError where none can be made: it needs Linux, root and iproute2."""
    if shutil.which("ip") is None or os.geteuid():
        raise UntriedError("a network namespace needs root and the command ip")
    # Of the range for tests of networks (RFC 2544), four addresses for each process.
    here, there = (ipaddress.ip_address("198.18.0.0") + 4 * (os.getpid() % 2**14) + k for k in (1, 2))
    host = Host(f"faults{os.getpid()}", str(here))
    _ip("netns", "add", host.name)
    try:
        _ip("link", "add", host.name, "type", "veth", "peer", "name", "there", "netns", host.name)
        _ip("addr", "add", f"{here}/30", "dev", host.name)
        _ip("-n", host.name, "addr", "add", f"{there}/30", "dev", "there")
        _ip("link", "set", host.name, "up")
        for device in ("lo", "there"):
            _ip("-n", host.name, "link", "set", device, "up")
        yield host
    finally:
        _ip("netns", "del", host.name)


def cut(name: str, times: int, draw: np.random.Generator, place: Path) -> Seen:
    """The network to the workers is down for some seconds: the command goes on."""
    job, digest = reference(place, name)
    seen = Seen()
    with (
        other_host() as host,
        dask_scheduler(place, host.here) as (address, _),
        dask_workers(address, 2, *host.words),
    ):
        for k in range(times):
            out = place / f"cut-{k}"
            with running(job.line(out, "--cluster", address)) as (process, ended):
                begun(job, out, int(draw.integers(1, 8)))(process)
                before, alive = job.finished(out), process.poll() is None
                host.cut(float(draw.uniform(1.0, 20.0)))
                seen.times += alive
                found = ended()
            seen.look(job, out, before)
            seen.compare(job, out, digest, found)
    return seen
