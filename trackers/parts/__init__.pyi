from trackwright.trackers.core.filters.filter import AbstractSmoothableFilter as AbstractSmoothableFilter
from trackwright.trackers.core.filters.filter import Innovation as Innovation
from trackwright.trackers.core.filters.imm import InteractingModels as InteractingModels
from trackwright.trackers.core.filters.imm import SwitchingMotion as SwitchingMotion
from trackwright.trackers.core.model.motion import Accelerated as Accelerated
from trackwright.trackers.core.model.motion import ConstantPosition as ConstantPosition
from trackwright.trackers.core.model.motion import GroundMotion as GroundMotion
from trackwright.trackers.core.model.motion import Placed as Placed
from trackwright.trackers.core.model.state import Rotation as Rotation
from trackwright.trackers.core.model.state import wrap as wrap
from trackwright.trackers.core.run.track_loss import TrackScorePolicy as TrackScorePolicy
from trackwright.trackers.parts.fixes import CorrelatedFixSensor as CorrelatedFixSensor
from trackwright.trackers.parts.singer import Singer as Singer
from trackwright.trackers.parts.start_nearby import NearbyStart as NearbyStart

__all__ = [
    "AbstractSmoothableFilter",
    "Accelerated",
    "ConstantPosition",
    "CorrelatedFixSensor",
    "GroundMotion",
    "Innovation",
    "InteractingModels",
    "NearbyStart",
    "Placed",
    "Rotation",
    "Singer",
    "SwitchingMotion",
    "TrackScorePolicy",
    "wrap",
]
