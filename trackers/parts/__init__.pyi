from trackwright.trackers.core.filters.ekf import ExtendedKalman as ExtendedKalman
from trackwright.trackers.core.filters.filter import AbstractSmoothableFilter as AbstractSmoothableFilter
from trackwright.trackers.core.filters.filter import Innovation as Innovation
from trackwright.trackers.core.filters.imm import InteractingModels as InteractingModels
from trackwright.trackers.core.filters.imm import SwitchingMotion as SwitchingMotion
from trackwright.trackers.core.filters.particle.filter import ParticleFilter as ParticleFilter
from trackwright.trackers.core.model.motion import Accelerated as Accelerated
from trackwright.trackers.core.model.motion import ConstantPosition as ConstantPosition
from trackwright.trackers.core.model.motion import ConstantVelocity as ConstantVelocity
from trackwright.trackers.core.model.motion import GroundMotion as GroundMotion
from trackwright.trackers.core.model.motion import Kinematic as Kinematic
from trackwright.trackers.core.model.motion import Placed as Placed
from trackwright.trackers.core.model.state import Rotation as Rotation
from trackwright.trackers.core.model.state import wrap as wrap
from trackwright.trackers.core.run.track_loss import TrackLossPolicy as TrackLossPolicy
from trackwright.trackers.core.run.track_loss import TrackScorePolicy as TrackScorePolicy
from trackwright.trackers.parts.fixes import CorrelatedFixSensor as CorrelatedFixSensor
from trackwright.trackers.parts.fixes import FixSensor as FixSensor
from trackwright.trackers.parts.fixes import fix_trajectories as fix_trajectories
from trackwright.trackers.parts.ranges import RangeSensor as RangeSensor
from trackwright.trackers.parts.ranges import range_trajectories as range_trajectories
from trackwright.trackers.parts.singer import Singer as Singer
from trackwright.trackers.parts.start_nearby import NearbyStart as NearbyStart

__all__ = [
    "AbstractSmoothableFilter",
    "Accelerated",
    "ConstantPosition",
    "ConstantVelocity",
    "CorrelatedFixSensor",
    "ExtendedKalman",
    "FixSensor",
    "GroundMotion",
    "Innovation",
    "InteractingModels",
    "Kinematic",
    "NearbyStart",
    "ParticleFilter",
    "Placed",
    "RangeSensor",
    "Rotation",
    "Singer",
    "SwitchingMotion",
    "TrackLossPolicy",
    "TrackScorePolicy",
    "fix_trajectories",
    "range_trajectories",
    "wrap",
]
