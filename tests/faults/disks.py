"""Folders that take no more files, and files that lose their end."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from tests.faults.jobs import Ended, Job, reference, temporary
from tests.faults.seen import Seen, UntriedError
from tests.in_process import trackwright

Draw = np.random.Generator


@contextmanager
def small_disk(folder: Path, kilobytes: int) -> Iterator[None]:
    """A file system of this size at the folder; raises UntriedError without the right to mount one."""
    folder.mkdir()
    line = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(line, capture_output=True).returncode:
        raise UntriedError("no right to mount a small file system here")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def _remounted(folder: Path, options: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{options}", str(folder)], check=True)


def _here(job: Job, out: Path) -> Ended:
    """The command within this process, which has imported everything."""
    return Ended(*trackwright(*job.words, "--out", out))


def full(name: str, times: int, draw: Draw, place: Path) -> Seen:
    """A disk that is full at some point of a command; with more space the same command goes on."""
    job, digest = reference(place, name, _here)
    needed = sum(-(-path.stat().st_size // 4096) * 4 for path in (place / "whole").rglob("*") if path.is_file())
    seen, k = Seen(), 0
    while seen.times < times:
        disk, k = place / f"disk-{k}", k + 1
        with small_disk(disk, int(draw.uniform(4, needed))):
            out = disk / "out"
            ended = _here(job, out)
            if ended.code == 0:  # what lay there for a moment made the estimate too large
                continue
            seen.times += 1
            seen.refused(ended, disk, 2, "space")  # Polars does not always say "No space left"
            seen.left += len(temporary(out))
            before = seen.look(job, out, set())
            _remounted(disk, "size=64m")
            ended = _here(job, out)
            seen.look(job, out, before)
            seen.compare(job, out, digest, ended)
    return seen


def _stamps(folder: Path) -> dict[Path, tuple[int, int]]:
    """When each file and folder in there was changed last, and its inode: another one where it was written again."""
    return {path: (path.stat().st_mtime_ns, path.stat().st_ino) for path in folder.rglob("*")}


def read_only(name: str, times: int, draw: Draw, place: Path) -> Seen:
    """A folder that cannot be written to, empty or with results, which stay as they are."""
    job, digest = reference(place, name, _here)
    seen = Seen()
    for k in range(times):
        disk = place / f"disk-{k}"
        with small_disk(disk, 65_536):
            out = disk / "out"
            if k % 2 == 0:
                shutil.copytree(place / "whole", out)
                seen.compare(job, out, digest, _here(job, out))
            before = _stamps(disk)
            _remounted(disk, "ro")
            ended = _here(job, out)
            seen.times += 1
            seen.refused(ended, disk, 2, "Read-only file system")
            now = _stamps(disk)
            seen.lost += len(before.items() - now.items())
            _remounted(disk, "rw")
            seen.compare(job, out, digest, _here(job, out))
    return seen


def cut(name: str, times: int, draw: Draw, place: Path) -> Seen:
    """A file of the results loses its end: it is computed again, or refused by its name until it is removed."""
    job, digest = reference(place, name, _here)
    seen = Seen()
    for k in range(times):
        out = place / f"cut-{k}"
        shutil.copytree(place / "whole", out)
        files = sorted(path for path in out.rglob("*") if path.is_file())
        path = files[draw.integers(len(files))]
        size = path.stat().st_size
        before = {one: one.stat().st_ino for one in out.glob("chunks/[0-9]*.npz") if one != path}
        with path.open("rb+") as file:
            file.truncate(int(draw.integers(size)))
        ended = _here(job, out)
        seen.times += 1
        if ended.code:
            seen.refused(ended, out, 2, path.name)
            path.unlink()
            ended = _here(job, out)
        seen.lost += sum(one.stat().st_ino != number for one, number in before.items())
        seen.compare(job, out, digest, ended)
        shutil.rmtree(out)
    return seen
