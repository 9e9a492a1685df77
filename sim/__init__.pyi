from trackwright.sim.agv import Route as Route
from trackwright.sim.agv import VehicleDraw as VehicleDraw
from trackwright.sim.corruptions import Corruption as Corruption
from trackwright.sim.corruptions import antenna_biases as antenna_biases
from trackwright.sim.corruptions import correlated_noise as correlated_noise
from trackwright.sim.corruptions import corrupted as corrupted
from trackwright.sim.corruptions import delayed as delayed
from trackwright.sim.corruptions import drop_outs as drop_outs
from trackwright.sim.corruptions import gauss_markov as gauss_markov
from trackwright.sim.corruptions import lose_station as lose_station
from trackwright.sim.corruptions import mask_antenna as mask_antenna
from trackwright.sim.corruptions import mirrored_heights as mirrored_heights
from trackwright.sim.corruptions import obstruction as obstruction
from trackwright.sim.corruptions import outliers as outliers
from trackwright.sim.corruptions import round_robin as round_robin
from trackwright.sim.corruptions import white_noise as white_noise
from trackwright.sim.imu import ImuDraw as ImuDraw
from trackwright.sim.keys import normals as normals
from trackwright.sim.keys import stream as stream
from trackwright.sim.keys import trajectory_keys as trajectory_keys
from trackwright.sim.keys import uniforms as uniforms
from trackwright.sim.line import LineDraw as LineDraw
from trackwright.sim.paths import PATHS as PATHS
from trackwright.sim.paths import WALK as WALK
from trackwright.sim.paths import WORK_VOLUME as WORK_VOLUME
from trackwright.sim.paths import PathFunction as PathFunction
from trackwright.sim.paths import hand_motion as hand_motion
from trackwright.sim.paths import helix as helix
from trackwright.sim.ranging import DifferenceDraw as DifferenceDraw
from trackwright.sim.ranging import Protocol as Protocol
from trackwright.sim.ranging import RangeDraw as RangeDraw
from trackwright.sim.ranging import TrolleyDraw as TrolleyDraw
from trackwright.sim.ranging import chamber as chamber
from trackwright.sim.ranging import two_way_ranges as two_way_ranges
from trackwright.sim.stations import FusionDraw as FusionDraw
from trackwright.sim.stations import PhaseDraw as PhaseDraw
from trackwright.sim.stations import facing as facing
from trackwright.sim.stations import plane_phases as plane_phases
from trackwright.sim.stations import spherical_phases as spherical_phases
from trackwright.sim.stations import work_station as work_station
from trackwright.sim.tables import SimulatedWorld as SimulatedWorld

__all__ = [
    # phases at stations
    "work_station",
    "PhaseDraw",
    "facing",
    # measurements of the other systems
    "LineDraw",
    "RangeDraw",
    "DifferenceDraw",
    "chamber",
    "ImuDraw",
    "TrolleyDraw",
    "FusionDraw",
    "VehicleDraw",
    "Route",
    "Protocol",
    "two_way_ranges",
    # paths
    "PATHS",
    "PathFunction",
    "WALK",
    "WORK_VOLUME",
    "hand_motion",
    "helix",
    # phases
    "spherical_phases",
    "plane_phases",
    # what goes wrong
    "Corruption",
    "corrupted",
    "white_noise",
    "gauss_markov",
    "outliers",
    "drop_outs",
    "mask_antenna",
    "lose_station",
    "antenna_biases",
    "obstruction",
    "round_robin",
    "correlated_noise",
    "delayed",
    "mirrored_heights",
    # a world by name
    "SimulatedWorld",
    # random numbers by trajectory
    "trajectory_keys",
    "stream",
    "normals",
    "uniforms",
]
