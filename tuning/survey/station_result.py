"""What a survey of stations found: positions, rotations and gains with intervals, verdicts, and their table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.data.consistency import NORMAL
from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.recordings.calibration import ANGLE_PRIOR
from trackwright.tuning.survey.result import DETERMINED, Survey, with_interval

TURN_DETERMINED = np.deg2rad(3.0)
"""Half-width of a 95 % interval, rad, up to which a turn counts as determined; weakly so up to four times of it."""

FAR = 5.0
"""Distance, m, at which turns and moves of a station are compared."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class StationSurvey(Survey):
    """Stations with their positions, rotations and gains.

    `rotations` (S, 4): unit quaternions w, x, y, z, array frame to world frame. `gains` (S, 2): of azimuth and
    elevation, by which a station's angles are larger than true ones. `covariance` (8S, 8S): of the position, m, of
    turns about the array's axes, rad, and of the gains of each station in turn. `scales`, `rms`, `rms_before` (of the
    rig as it was, None where it states no rotations), rad, and `readings` (2S,): of azimuths and elevations in turn.
    `fixed_height`: whether the tags' heights are known.
    """

    rotations: Float[np.ndarray, "S 4"]
    gains: Float[np.ndarray, "S 2"]
    rms_before: Float[np.ndarray, " levels"] | None
    fixed_height: bool

    noun, found = "station", "Positions, rotations and gains"
    head = ("station", "x, m", "y, m", "z, m", "yaw, °", "pitch, °", "roll, °", "gain az", "el", "rms, °", "verdict")

    def before_onto(self) -> Float[np.ndarray, "S 3"]:
        return np.array([self.before.stations[name].position for name in self.names])

    def numbers(self, k: int) -> dict[str, Any]:
        (heading, tilt), widths = self.turns(k), self.half_widths[k]
        over, height, turned, tilted = self.determined(self.names[k])
        return {
            "position_m": self.positions[k], "half_width_m": widths[:3], "rotation_wxyz": self.rotations[k],
            "yaw_pitch_roll_deg": np.rad2deg(self.angles()[k]), "heading_half_width_deg": np.rad2deg(heading),
            "tilt_half_width_deg": np.rad2deg(tilt), "gains": self.gains[k], "gains_half_width": widths[6:],
            "determined": {"xy": over, "z": height, "heading": turned, "tilt": tilted},
            "rms_deg": np.rad2deg(self.rms.reshape(-1, 2)[k]), "bearings": self.readings.reshape(-1, 2)[k],
        }  # fmt: skip

    def angles(self) -> Float[np.ndarray, "S 3"]:
        """Yaw, pitch and roll of the stations, rad, as rig.toml has them."""
        left, up, ahead = np.moveaxis(rotation_matrices(self.rotations), -1, 0)
        yaw, pitch = np.arctan2(ahead[:, 1], ahead[:, 0]), np.arctan2(-ahead[:, 2], np.hypot(ahead[:, 0], ahead[:, 1]))
        return np.stack([yaw, pitch, np.arctan2(left[:, 2], up[:, 2])], axis=1)

    def turns(self, k: int) -> tuple[float, float]:
        """Half-widths of the 95 % intervals of heading and tilt of station `k`, rad: about the vertical, and of it."""
        axes = rotation_matrices(self.rotations[k])
        block = axes @ self.block(k)[3:6, 3:6] @ axes.T
        return NORMAL * float(np.sqrt(block[2, 2])), NORMAL * float(np.sqrt(np.linalg.eigvalsh(block[:2, :2])[-1]))

    def determined(self, name: str) -> tuple[bool, bool, bool, bool]:
        """Whether x and y, the height, the heading and the tilt of a station are determined."""
        flat, height, heading, tilt = (extent <= 1.0 for extent, _ in self._doubts(self._number(name)))
        return flat, height, heading, tilt

    def verdict(self, name: str) -> str:
        k = self._number(name)
        return self._worded(k, self._doubts(k))

    def _doubts(self, k: int) -> list[tuple[float, str]]:
        (flat, height), (heading, tilt) = self._extents(k), self.turns(k)
        of_turns = (heading / TURN_DETERMINED, "heading"), (tilt / TURN_DETERMINED, "tilt")
        return [(flat / DETERMINED, "x, y"), (height / DETERMINED, "height"), *of_turns]

    def _advice(self, k: int) -> str:
        axes, name = rotation_matrices(self.rotations[k]), self.names[k]
        whole = np.zeros((6, 6))
        whole[:3, :3], whole[3:, 3:] = np.eye(3), FAR * axes
        values, vectors = np.linalg.eigh(whole @ self.block(k)[:6, :6] @ whole.T)
        if values[-1] > FAR**2 and not self.fixed_height:
            return "state the height of the tag, or give the position of one more station"
        places = np.concatenate(self.paths)
        upright = np.hypot(*vectors[[2, 3], -1]) ** 2 + vectors[4, -1] ** 2
        if upright > 0.5 and np.ptp(places[:, 2]) < 1.0:
            return f"walk close to {name} and away from it, and at two heights"
        offset = (places - self.positions[k])[:, :2]
        distances = np.linalg.norm(offset, axis=1)
        if distances.max() < 3.0 * distances.min():
            return f"walk close to {name} and away from it"
        return f"walk longer, to all sides of {name}"

    def rows(self) -> list[list[str]]:
        angles, rms, widths = np.rad2deg(self.angles()), np.rad2deg(self.rms).reshape(-1, 2), self.half_widths
        before = None if self.rms_before is None else np.rad2deg(self.rms_before).reshape(-1, 2)
        known_gains = widths[:, 6:] < 0.7 * NORMAL * ANGLE_PRIOR[1][1]
        rows = []
        for k, name in enumerate(self.names):
            over, height, heading, tilt = self.determined(name)
            # Yaw turns about the array's y axis, pitch about its x axis.
            turns = np.rad2deg(widths[k, [4, 3, 5]])
            steady = heading and tilt
            values = np.concatenate([self.positions[k], angles[k], self.gains[k]])
            around = np.concatenate([widths[k, :3], turns, widths[k, 6:]])
            known = (over, over, height, steady, steady, steady, *known_gains[k].tolist())
            cells = [with_interval(*of) for of in zip(values, around, known, strict=True)]
            misses = ", ".join(f"{x:.1f}" for x in rms[k])
            if before is not None:
                misses = f"{', '.join(f'{x:.1f}' for x in before[k])} → {misses}"
            rows.append([name, *cells, misses, self.verdict(name)])
        return rows

    @property
    def reading(self) -> str:
        return (
            f"{super().reading} Intervals of yaw, pitch and roll are those of turns about the array's y, x and z axis. "
            "rms: of azimuth and elevation"
            + (", with the rig as it was and as surveyed." if self.rms_before is not None else ".")
        )
