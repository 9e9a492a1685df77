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
from sim.fixes import correlated_noise, delayed, first_order_lag, mirrored_heights
from sim.imu import simulate_uwb_imu
from sim.keys import normals, stream, trajectory_keys, uniforms
from sim.line import simulate_line
from sim.paths import PATHS, WORK_VOLUME, PathFunction, hand_motion, helix, point_to_point, straight_lines_with_halts
from sim.phases import plane_phases, spherical_phases
from sim.ranging import Protocol, antenna_biases, chamber, obstruction, round_robin, simulate_ranges, two_way_ranges
from sim.signal import Radar, Reflector, phase_sigma, signal_phases
from sim.stations import SimulatedPhases, facing, simulate_phases, work_station
from sim.worlds import SimulatedWorld

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
    "SimulatedWorld",
    "antenna_biases",
    "chamber",
    "constant_offsets",
    "correlated_noise",
    "corrupted",
    "delayed",
    "drop_outs",
    "facing",
    "first_order_lag",
    "gauss_markov",
    "hand_motion",
    "helix",
    "lose_station",
    "mask_antenna",
    "mirrored_heights",
    "normals",
    "obstruction",
    "outliers",
    "phase_sigma",
    "plane_phases",
    "point_to_point",
    "round_robin",
    "signal_phases",
    "simulate_agv",
    "simulate_line",
    "simulate_phases",
    "simulate_ranges",
    "simulate_uwb_imu",
    "spherical_phases",
    "straight_lines_with_halts",
    "stream",
    "trajectory_keys",
    "two_way_ranges",
    "uniforms",
    "white_noise",
    "work_station",
]
