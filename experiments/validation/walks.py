"""Recorded walks, tuned on the first runs, evaluated on the second: `python -m experiments.validation.walks`."""

from __future__ import annotations

import sys
from pathlib import Path

from experiments.cli.subprocesses import command, figures, real_recordings
from experiments.reports.tables import aligned

OUT = Path("out/walks")
USE_CASES = ("u1", "u2", "u3")
PATTERNS = ("motion.*", "sensors.*.sigma_*", "sensors.*.dof", "sensors.*.offsets", "sensors.*.compression")


def main() -> None:
    """Tune on `ble51-walk-*-r1`, track `ble51-walk-*-r2` with one set of noise levels, and print the table."""
    folder = real_recordings()
    if folder is None:
        sys.exit(
            "walks: no folder of real recordings, expected ../shared/recordings or what TRACKWRIGHT_RECORDINGS names"
        )
    first, second = ([folder / f"ble51-walk-{u}-r{run}" for u in USE_CASES] for run in (1, 2))
    # One start, the defaults: other starts reach a lower RMSE on these three walks, but not on others.
    goal = ("--free-height", "--objective", "rmse", "--steps", "80", "--starts", "1", "--tune", *PATTERNS)
    command("tune", *first, *goal, "--out", OUT / "tuned")
    noise = ("--noise", OUT / "tuned" / "tuned.toml")
    command("track", *second, *noise, "--out", OUT / "known-height")
    command("track", *second, *noise, "--free-height", "--out", OUT / "free-height")
    command("track", *second, *noise, "--smooth", "--out", OUT / "smoothed")
    names = ("known-height", "free-height", "smoothed")
    known, free, smoothed = ({r["recording"]: r for r in figures(OUT / name)["recordings"]} for name in names)
    print("\nRMSE in m, tuned on the r1 recordings, one noise set for all")
    heads = ("horizontal, height known", "… smoothed", "horizontal, height free", "3-D, height free")
    table: list[tuple[str, ...]] = [("recording", *heads)]
    for path in second:
        a, b, c = known[path.name], free[path.name], smoothed[path.name]
        errors = (a["rmse_m"], c["rmse_m"], b["rmse_m"], b["rmse_3d_m"])
        table.append((path.name, *(f"{error:.2f}" for error in errors)))
    print(aligned(table, range(1, 5)))


if __name__ == "__main__":
    main()
