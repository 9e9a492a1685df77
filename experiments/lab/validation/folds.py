"""The table of folds over the real recordings: which recordings are judged, by which tracker, and what each saw.

A fold is judged on recordings that its calibration and its tuning have not seen. Where no earlier run of the site
exists, each half of a recording is judged with the calibration of the other half (`OTHER_HALF`).
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

WALKS = tuple(f"ble51-walk-u{k}-r1" for k in (1, 2, 3))

SEEN_BY_DEFAULTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "bearings": WALKS,
        "uwb": (
            "starloc-fast-s1",
            "starloc-2d-s5",
            "rcv-drone-3",
            "iasl-drone-1",
            "lias-planar-fast",
            "labyrinth",
            "ngbui-line-1-1",
            "ngbui-line-2-1",
        ),
        "uwb-imu": ("starloc-fast-s1", "iasl-drone-1"),
        "fix-mirror": ("tiers-1tag-01",),
    }
)
"""The recordings on which the default noise levels of a tracker were set."""

OTHER_HALF: Final = ("the other half",)
"""Calibrated on the other half, in time, of the judged recording."""

OTHERS: Final = ("the others",)
"""Calibrated on the other judged recordings of the fold."""


class Honest(NamedTuple):
    """Limits, lowest and highest, of the share of the truth inside the 95 % ellipse and of NEES/dof."""

    inside: tuple[float, float]
    nees: tuple[float, float]


DEFAULTS = Honest((0.85, 0.99), (0.5, 2.0))
CALIBRATED = Honest((0.90, 0.98), (0.7, 1.5))


class Fold(NamedTuple):
    """Recordings judged by one tracker, and the limits of their errors, m.

    `rmse`, `smoothed`, `spatial`: highest horizontal RMSE of the filter and of the smoother, and 3-D RMSE of the
    filter, means over the recordings; None for no limit. `honest`: limits of each recording, filtered and smoothed.
    `calibrated_on`: recordings, `OTHER_HALF` or `OTHERS`. `tuned_on`, `tuned`: recordings and tunables of a fit of the
    3-D RMSE. `smoothes`: whether the tracker has a smoother. `quick`: part of the run of two minutes.
    """

    name: str
    tracker: str
    judged: tuple[str, ...]
    honest: Honest | None = DEFAULTS
    rmse: float | None = None
    smoothed: float | None = None
    spatial: float | None = None
    calibrated_on: tuple[str, ...] = ()
    tuned_on: tuple[str, ...] = ()
    tuned: tuple[str, ...] = ()
    smoothes: bool = True
    free_height: bool = False
    quick: bool = False

    @property
    def limits(self) -> tuple[tuple[str, str, bool, float | None], ...]:
        """Name, metric, whether smoothed, and highest mean of each error."""
        horizontal = ("RMSE", "rmse_m", False, self.rmse), ("RMSE", "rmse_m", True, self.smoothed)
        return *horizontal, ("3-D RMSE", "rmse_3d_m", False, self.spatial)


SECOND_RUNS = tuple(f"ble51-walk-u{k}-r2" for k in (1, 2, 3))
STILL = ("lias-still-p1-0", "lias-still-p3-180", "lias-still-p5-0")
FLIGHTS = ("tiers-2tag-01", "tiers-2tag-03", "tiers-2tag-06")

# fmt: off
FOLDS = (
    # Bearings of Bluetooth arrays, height known.
    Fold("walks", "bearings", SECOND_RUNS, rmse=0.80, quick=True),
    Fold("walks, calibrated", "bearings", SECOND_RUNS, CALIBRATED, 0.50, 0.40, calibrated_on=WALKS, quick=True),
    Fold("walks, use case left out", "bearings", WALKS, None, calibrated_on=OTHERS),
    Fold("walks, height unknown", "bearings", SECOND_RUNS, None, calibrated_on=WALKS, free_height=True),
    # Ranges.
    Fold("starloc-fast", "uwb", ("starloc-fast-s1",), rmse=0.20),
    Fold("starloc-fast, calibrated", "uwb", ("starloc-fast-s1",), CALIBRATED, 0.15, spatial=0.26,
         calibrated_on=OTHER_HALF),
    Fold("starloc-fast with IMU", "uwb-imu", ("starloc-fast-s1",)),
    Fold("starloc-2d", "uwb", ("starloc-2d-s5",)),
    Fold("starloc-2d, calibrated", "uwb", ("starloc-2d-s5",), CALIBRATED, calibrated_on=OTHER_HALF),
    Fold("lias trolley", "uwb", ("lias-planar-fast",), rmse=0.08),
    Fold("lias trolley, calibrated", "uwb", ("lias-planar-fast",), CALIBRATED, 0.06, calibrated_on=STILL),
    Fold("rcv drone", "uwb", ("rcv-drone-3",), rmse=0.22, quick=True),
    Fold("rcv drone, calibrated", "uwb", ("rcv-drone-3",), CALIBRATED, 0.20, spatial=0.90, calibrated_on=OTHER_HALF,
         quick=True),
    Fold("iasl drone", "uwb", ("iasl-drone-1",), rmse=0.06),
    Fold("iasl drone, calibrated", "uwb", ("iasl-drone-1",), CALIBRATED, 0.05, spatial=0.11, calibrated_on=OTHER_HALF),
    Fold("labyrinth", "uwb", ("labyrinth",)),
    # A straight path behind walls, which this tracker is not given.
    Fold("ngbui lines without the path", "uwb", ("ngbui-line-2-1", "ngbui-line-3-1"), None),
    # Ranges along a known path; the limits are the errors of earlier versions.
    Fold("ngbui line 1", "line-grid", ("ngbui-line-1-1",), rmse=0.032, smoothes=False),
    Fold("ngbui line 2", "line-grid", ("ngbui-line-2-1",), rmse=0.062, smoothes=False),
    Fold("ngbui line 3", "line-grid", ("ngbui-line-3-1",), rmse=0.442, smoothes=False),
    # Late fixes of drones, which may be mirrored in the anchors' plane; the limit is the mean of earlier versions.
    Fold("tiers drones", "fix-mirror", FLIGHTS, rmse=0.074, tuned_on=("tiers-1tag-01",), tuned=("*latency*",)),
)
# fmt: on
"""Every fold, the limits of default noise levels before those of a calibrated site."""


class Site(NamedTuple):
    """The recordings of one installation, and the tracker whose noise levels are fitted to them."""

    name: str
    tracker: str
    recordings: tuple[str, ...]


SITES = (
    Site("rcv", "uwb", ("rcv-drone-3", "rcv-drone-6")),
    Site("isas", "uwb", ("isas-walk-1",)),
    Site("starloc-2d", "uwb", ("starloc-2d-s5",)),
    Site("tiers", "fix-mirror", ("tiers-1tag-01", *FLIGHTS)),
    Site("starloc-fast", "uwb", ("starloc-fast-s1",)),
    Site("iasl", "uwb", ("iasl-drone-1", "iasl-drone-2")),
    Site("labyrinth", "uwb", ("labyrinth",)),
    Site("walks", "bearings", (*WALKS, *SECOND_RUNS)),
    Site("lias", "uwb", ("lias-planar-fast", *STILL)),
    *(Site(f"ngbui line {k}", "line-grid", (f"ngbui-line-{k}-1", f"ngbui-line-{k}-2")) for k in (1, 2, 3)),
)
"""The sites of the recordings, for fits with one recording left out each."""
