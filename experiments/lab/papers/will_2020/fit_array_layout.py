"""Fit of the default array: positions of eight antennas whose Cramér–Rao bounds have the ratios of Table 1's errors.

`fitted_layout` gives the layout of trackers/aoa/phases.py. Gauss-Newton iterations over seeded starts find some hundred
exact layouts; of these, scaled to fill the box, the one with the lowest side lobes is chosen, so that a beamformer
rarely starts a track on a wrong lobe. The printed errors are a filter's, not bounds: this is a fit, not a
reconstruction of the array.
"""

import numpy as np

from trackwright.trackers.aoa.phases import DEFAULT_WAVELENGTH, boresight_bounds

TABLE_1_DEG = {
    (1, 2, 3, 4, 5, 6, 7, 8): (0.583, 0.893),
    (3, 7, 8): (2.194, 10.731),
    (2, 7, 8): (1.051, 4.764),
    (1, 2, 5): (13.227, 1.964),
    (2, 3, 6): (0.668, 0.974),
}
"""Paper A, Table 1: antenna set (counted from 1) -> root mean square error of azimuth and elevation, degrees."""

HALF_BOX = np.array([0.04, 0.02])
SMALLEST_SPACING = DEFAULT_WAVELENGTH / 2
STARTS, ITERATIONS, LONGEST_STEP = 2000, 40, 0.005


def log_ratios(layouts: np.ndarray) -> np.ndarray:
    """Log of bound over printed error (..., 10), less its mean; zero if a layout (..., 8, 2) has the ratios."""
    sets = [boresight_bounds(layouts[..., np.array(chosen) - 1, :]) for chosen in TABLE_1_DEG]
    logs = np.log(np.concatenate(sets, axis=-1)) - np.log(np.concatenate(list(TABLE_1_DEG.values())))
    return logs - logs.mean(axis=-1, keepdims=True)


def exact_layouts(seed: int = 0) -> np.ndarray:
    """Layouts (k, 8, 2), m, with exactly the ratios of Table 1, filling the box, antennas half a wavelength apart."""
    layouts = np.random.default_rng(seed).uniform(-1, 1, (STARTS, 8, 2)) * HALF_BOX
    for _ in range(ITERATIONS):
        residual, jacobian = log_ratios(layouts), _jacobian(layouts)
        # The residuals sum to zero; the added constant restores full rank and changes no step.
        square = jacobian @ jacobian.swapaxes(-1, -2) + np.ones((10, 10)) * 1e4
        step = -(jacobian.swapaxes(-1, -2) @ np.linalg.solve(square, residual[..., None]))[..., 0]
        step *= np.minimum(1, LONGEST_STEP / np.abs(step).max(axis=-1, keepdims=True).clip(1e-30))
        layouts = layouts + step.reshape(layouts.shape)
    layouts = layouts[np.abs(log_ratios(layouts)).max(axis=-1) < 1e-9]
    layouts -= (layouts.max(axis=1, keepdims=True) + layouts.min(axis=1, keepdims=True)) / 2
    layouts *= (HALF_BOX / np.abs(layouts).max(axis=1)).min(axis=1)[:, None, None]
    spacing = np.linalg.norm(layouts[:, :, None] - layouts[:, None], axis=-1) + np.eye(8)
    return layouts[spacing.min(axis=(1, 2)) >= SMALLEST_SPACING]


def side_lobe(layout: np.ndarray) -> float:
    """The array factor's largest value (the beam's own is 1) outside the main beam, between any +-30 degrees."""
    du, dv = np.meshgrid(np.linspace(0, 1, 41), np.linspace(-1, 1, 81), indexing="ij")
    phases = 2 * np.pi / DEFAULT_WAVELENGTH * (du[..., None] * layout[:, 0] + dv[..., None] * layout[:, 1])
    factor = np.abs(np.exp(1j * phases).mean(axis=-1))
    beam = (du / 0.25) ** 2 + (dv / 0.4) ** 2 < 1
    return float(factor[~beam].max())


def fitted_layout() -> np.ndarray:
    """The layout (8, 2), m, with the lowest side lobes, rounded to 0.01 mm."""
    return np.round(min(exact_layouts(), key=side_lobe), 5)


def _jacobian(layouts: np.ndarray) -> np.ndarray:
    """Derivative (k, 10, 16) of `log_ratios` by complex steps: exact to rounding."""
    columns = []
    for i in range(16):
        moved = layouts.astype(complex)
        moved[:, i // 2, i % 2] += 1e-30j
        columns.append(log_ratios(moved).imag / 1e-30)
    return np.stack(columns, axis=-1)
