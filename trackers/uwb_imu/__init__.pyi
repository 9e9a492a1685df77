from trackwright.trackers.uwb_imu.strapdown import PlanarStrapdown as PlanarStrapdown
from trackwright.trackers.uwb_imu.strapdown import Strapdown as Strapdown
from trackwright.trackers.uwb_imu.trilateration import double_sided as double_sided
from trackwright.trackers.uwb_imu.trilateration import single_sided as single_sided

__all__ = [
    "PlanarStrapdown",
    "Strapdown",
    "double_sided",
    "single_sided",
]
