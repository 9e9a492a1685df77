from trackwright.trackers.exchange.compare import TrajectoryErrors as TrajectoryErrors
from trackwright.trackers.exchange.compare import compare_trajectories as compare_trajectories
from trackwright.trackers.exchange.imported import import_frames as import_frames
from trackwright.trackers.exchange.poses import PoseTrajectory as PoseTrajectory
from trackwright.trackers.exchange.trajectory_files import read_trajectory as read_trajectory
from trackwright.trackers.exchange.trajectory_files import write_trajectory as write_trajectory

__all__ = [
    "PoseTrajectory",
    "TrajectoryErrors",
    "compare_trajectories",
    "import_frames",
    "read_trajectory",
    "write_trajectory",
]
