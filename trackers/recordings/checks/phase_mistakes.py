"""Explanations of errors of phases: sign, turns, exchanged antennas, their places, the wavelength, the orientation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import combinations

import numpy as np

from trackwright.trackers.recordings.checks.compared import Compared
from trackwright.trackers.recordings.checks.explanations import FACTORS, Explanation, sizes_with

LEAST_SCALE = 0.05
"""Logarithm of the ratio of two wavelengths that counts as a mistake."""

SIZES = (0.15, 10.0)
"""Smallest and largest plausible distance of an antenna from the station's position, wavelengths."""

LEAST_TURN = np.radians(15.0)
"""Turn of a station that counts as a mistake, rad."""


def of_phases(view: Compared) -> Iterator[Explanation]:
    """Changes of the phases, of the arrays and of the orientation that may hold for some stations alone."""
    yield Explanation(
        "the sign of the phases flipped", "phases that grow with the distance, or with the opposite sign; flip it",
        sizes_with(view, values=-view.values), own=True,
    )  # fmt: skip
    for factor, unit, seen in ((2 * np.pi, "turns", (0.1, 0.5)), (np.radians(1.0), "degrees", (np.pi, 360.0))):
        typical = _typical(view)
        kept = (typical > seen[0]) & (typical < seen[1])
        yield Explanation(
            f"the phases multiplied by {factor:.4g}", f"phases in {unit}, expected radians; convert them",
            sizes_with(view, values=factor * view.values), own=True, groups=kept,
        )  # fmt: skip
    yield from _of_antennas(view)
    yield from _of_wavelengths(view)
    yield from _turned(view)


def _typical(view: Compared) -> np.ndarray:
    """The median size of the phases of each station (G,), rad."""
    return np.array([np.nanmedian(np.abs(view.values[view.group == k])) for k in range(len(view.ids))])


def _resolving(view: Compared, factor: float | np.ndarray) -> np.ndarray:
    """Whether each array (G,), so many times as large, resolves directions: else phases are equal, or fit many."""
    size = factor * np.nanmax(np.abs(view.antennas), axis=(1, 2)) / view.wavelengths
    found: np.ndarray = (size > SIZES[0]) & (size < SIZES[1])
    return found


def _of_antennas(view: Compared) -> Iterator[Explanation]:
    """Other places of the antennas: mirrored, in another unit, or in another order of the columns."""
    changed = {
        "x of antennas_m flipped": (view.antennas * [-1.0, 1.0], "antennas seen from behind, or x with the wrong sign"),
        "y of antennas_m flipped": (view.antennas * [1.0, -1.0], "antennas seen from behind, or y with the wrong sign"),
        "x and y of antennas_m swapped": (view.antennas[..., ::-1], "x and y of antennas_m are swapped"),
    }
    for change, (antennas, cause) in changed.items():
        yield Explanation(change, f"{cause}; correct rig.toml", sizes_with(view, antennas=antennas), own=True)
    for factor, unit in FACTORS[:2]:
        yield Explanation(
            f"antennas_m multiplied by {factor:g}", f"antennas_m in {unit}, expected metres; convert them",
            sizes_with(view, antennas=factor * view.antennas), own=True, groups=_resolving(view, factor),
        )  # fmt: skip
        yield Explanation(
            f"wavelength_m multiplied by {factor:g}", f"wavelength_m in {unit}, expected metres; convert it",
            sizes_with(view, wavelengths=factor * view.wavelengths), own=True, groups=_resolving(view, 1 / factor),
        )  # fmt: skip
    count = len(view.columns)
    yield Explanation(
        "the antennas in reverse order", "the order of the antennas is reversed; correct rig.toml or the columns",
        sizes_with(view, values=view.values[:, ::-1]), own=True,
    )  # fmt: skip
    for shift in range(1, count):
        yield Explanation(
            f"phase_1_rad as that of antenna {shift + 1}", "the numbering of the antennas starts at another one; "
            "correct rig.toml or the columns", sizes_with(view, values=np.roll(view.values, shift, axis=1)), own=True,
        )  # fmt: skip
    for i, j in combinations(range(count), 2):
        order = np.arange(count)
        order[[i, j]] = j, i
        yield Explanation(
            f"phases {i + 1} and {j + 1} exchanged", "two antennas are swapped; correct rig.toml or the columns",
            sizes_with(view, values=view.values[:, order]), own=True,
        )  # fmt: skip


def _of_wavelengths(view: Compared) -> Iterator[Explanation]:
    """The wavelength of each station that makes its errors smallest."""

    def with_logs(logs: np.ndarray) -> np.ndarray:
        return sizes_with(view, wavelengths=view.wavelengths * np.exp(logs))

    logs = _searched(view, with_logs, np.linspace(np.log(0.25), np.log(4.0), 139))
    kept = (np.abs(logs) >= LEAST_SCALE) & _resolving(view, np.exp(-logs))
    yield Explanation(
        "another wavelength", "a wrong wavelength_m, or antennas_m in another scale; correct rig.toml",
        with_logs(logs), 1, True, kept,
        parts=tuple(f"{x:.4g} m" for x in np.exp(logs) * view.wavelengths),
    )  # fmt: skip


def _turned(view: Compared) -> Iterator[Explanation]:
    """Each station turned about the vertical by the angle that makes its errors smallest."""

    def with_turns(yaw: np.ndarray) -> np.ndarray:
        c, s, zero = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)
        rows = [
            np.stack([c, -s, zero], axis=1),
            np.stack([s, c, zero], axis=1),
            np.tile([0.0, 0.0, 1.0], (len(yaw), 1)),
        ]
        return sizes_with(view, axes=np.stack(rows, axis=1) @ view.axes)

    turns = np.mod(_searched(view, with_turns, np.radians(np.arange(-180.0, 180.0, 3.0))) + np.pi, 2 * np.pi) - np.pi
    yield Explanation(
        "the station turned about the vertical", "another orientation than rig.toml's; correct rotation_wxyz or "
        "yaw_deg", with_turns(turns), 1, True, np.abs(turns) >= LEAST_TURN,
        parts=tuple(f"by {x:.0f}°" for x in np.degrees(turns)),
    )  # fmt: skip


def _searched(view: Compared, sizes_of: Callable[[np.ndarray], np.ndarray], grid: np.ndarray) -> np.ndarray:
    """The number of each station (G,) with the smallest errors: the best of a grid, then of a finer one round it."""
    best, step = np.zeros(len(view.ids)), float(grid[1] - grid[0])
    for offsets in (grid, np.linspace(-step, step, 9)):
        costs = np.stack([np.nansum(np.log(sizes_of(best + x) + 1e-3), axis=1) for x in offsets])
        best = best + offsets[np.argmin(costs, axis=0)]
    return best
