from trackwright.trackers.from_arrays import range_recording as range_recording
from trackwright.trackers.uwb_imu.fusion import range_tracker as range_tracker
from trackwright.trackers.uwb_imu.inertial import inertial_tracker as inertial_tracker
from trackwright.trackers.uwb_imu.strapdown import PlanarStrapdown as PlanarStrapdown
from trackwright.trackers.uwb_imu.strapdown import Strapdown as Strapdown
from trackwright.trackers.uwb_imu.trilateration import double_sided as double_sided
from trackwright.trackers.uwb_imu.trilateration import multilateration_tracker as multilateration_tracker
from trackwright.trackers.uwb_imu.trilateration import single_sided as single_sided
from trackwright.trackers.uwb_imu.trilateration import trilateration_tracker as trilateration_tracker

__all__ = [
    "PlanarStrapdown",
    "Strapdown",
    "double_sided",
    "inertial_tracker",
    "multilateration_tracker",
    "range_recording",
    "range_tracker",
    "single_sided",
    "trilateration_tracker",
]
