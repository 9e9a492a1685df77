from sim.agv import Route as Route
from sim.agv import simulate_agv as simulate_agv
from sim.corruptions import Corruption as Corruption
from sim.corruptions import constant_offsets as constant_offsets
from sim.corruptions import corrupted as corrupted
from sim.corruptions import drop_outs as drop_outs
from sim.corruptions import gauss_markov as gauss_markov
from sim.corruptions import lose_station as lose_station
from sim.corruptions import mask_antenna as mask_antenna
from sim.corruptions import outliers as outliers
from sim.corruptions import white_noise as white_noise
from sim.fixes import correlated_noise as correlated_noise
from sim.fixes import delayed as delayed
from sim.fixes import first_order_lag as first_order_lag
from sim.fixes import mirrored_heights as mirrored_heights
from sim.imu import simulate_uwb_imu as simulate_uwb_imu
from sim.keys import normals as normals
from sim.keys import stream as stream
from sim.keys import trajectory_keys as trajectory_keys
from sim.keys import uniforms as uniforms
from sim.line import simulate_line as simulate_line
from sim.paths import PATHS as PATHS
from sim.paths import WORK_VOLUME as WORK_VOLUME
from sim.paths import PathFunction as PathFunction
from sim.paths import hand_motion as hand_motion
from sim.paths import helix as helix
from sim.paths import point_to_point as point_to_point
from sim.paths import straight_lines_with_halts as straight_lines_with_halts
from sim.phases import plane_phases as plane_phases
from sim.phases import spherical_phases as spherical_phases
from sim.ranging import Protocol as Protocol
from sim.ranging import antenna_biases as antenna_biases
from sim.ranging import chamber as chamber
from sim.ranging import obstruction as obstruction
from sim.ranging import round_robin as round_robin
from sim.ranging import simulate_ranges as simulate_ranges
from sim.ranging import two_way_ranges as two_way_ranges
from sim.signal import Radar as Radar
from sim.signal import Reflector as Reflector
from sim.signal import phase_sigma as phase_sigma
from sim.signal import signal_phases as signal_phases
from sim.stations import SimulatedPhases as SimulatedPhases
from sim.stations import facing as facing
from sim.stations import simulate_phases as simulate_phases
from sim.stations import work_station as work_station
from sim.worlds import SimulatedWorld as SimulatedWorld

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
