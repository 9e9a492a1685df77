"""Worlds with truth: paths, what an array receives along them, what goes wrong, and named scenarios of the papers."""

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
from sim.keys import normals, stream, trajectory_keys, uniforms
from sim.paths import WORK_VOLUME, hand_motion, helix, straight_lines_with_halts
from sim.phases import clean_phases, plane_phases
from sim.scenarios import PATHS, PathFunction, SimulatedPhases, facing, simulate_phases, work_station
from sim.signal import Radar, Reflector, phase_sigma, signal_phases

__all__ = [
    "PATHS",
    "WORK_VOLUME",
    "Corruption",
    "PathFunction",
    "Radar",
    "Reflector",
    "SimulatedPhases",
    "clean_phases",
    "constant_offsets",
    "corrupted",
    "drop_outs",
    "facing",
    "gauss_markov",
    "hand_motion",
    "helix",
    "lose_station",
    "mask_antenna",
    "normals",
    "outliers",
    "phase_sigma",
    "plane_phases",
    "signal_phases",
    "simulate_phases",
    "straight_lines_with_halts",
    "stream",
    "trajectory_keys",
    "uniforms",
    "white_noise",
    "work_station",
]
