"""Worlds with truth: paths, what an array receives along them, what goes wrong, and named scenarios of the papers."""

from sim.agv import Route, simulate_agv
from sim.corruptions import (
    Corruption,
    constant_offsets,
    corrupted,
    drop_outs,
    gauss_markov,
    lose_station,
    mask_antenna,
    outliers,
    white_noise,
)
from sim.fixes import correlated_noise, late, mirrored, sluggish
from sim.imu import simulate_uwb_imu
from sim.keys import normals, stream, trajectory_keys, uniforms
from sim.line import simulate_line
from sim.paths import WORK_VOLUME, hand_motion, helix, straight_lines_with_halts
from sim.phases import clean_phases, plane_phases
from sim.ranging import Protocol, antenna_biases, chamber, obstruction, one_at_a_time, simulate_ranges, two_way
from sim.scenarios import PATHS, PathFunction, SimulatedPhases, facing, simulate_phases, work_station
from sim.signal import Radar, Reflector, phase_sigma, signal_phases

__all__ = [
    "PATHS",
    "WORK_VOLUME",
    "Corruption",
    "PathFunction",
    "Protocol",
    "Radar",
    "Reflector",
    "Route",
    "SimulatedPhases",
    "antenna_biases",
    "chamber",
    "clean_phases",
    "constant_offsets",
    "correlated_noise",
    "corrupted",
    "drop_outs",
    "facing",
    "gauss_markov",
    "hand_motion",
    "helix",
    "late",
    "lose_station",
    "mask_antenna",
    "mirrored",
    "normals",
    "obstruction",
    "one_at_a_time",
    "outliers",
    "phase_sigma",
    "plane_phases",
    "signal_phases",
    "simulate_agv",
    "simulate_line",
    "simulate_phases",
    "simulate_ranges",
    "simulate_uwb_imu",
    "sluggish",
    "straight_lines_with_halts",
    "stream",
    "trajectory_keys",
    "two_way",
    "uniforms",
    "white_noise",
    "work_station",
]
