from trackwright.trackers.exchange.importing import import_frames as import_frames
from trackwright.trackers.exchange.trajectories import TrajectoryErrors as TrajectoryErrors
from trackwright.trackers.exchange.trajectories import compare_trajectories as compare_trajectories
from trackwright.trackers.exchange.trajectories import read_trajectory as read_trajectory
from trackwright.trackers.exchange.trajectories import write_trajectory as write_trajectory

__all__ = ["TrajectoryErrors", "compare_trajectories", "import_frames", "read_trajectory", "write_trajectory"]
