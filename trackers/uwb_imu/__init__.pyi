from trackwright.trackers.uwb_imu.ranging import double_sided as double_sided
from trackwright.trackers.uwb_imu.ranging import single_sided as single_sided
from trackwright.trackers.uwb_imu.strapdown import PlanarStrapdown as PlanarStrapdown
from trackwright.trackers.uwb_imu.strapdown import Strapdown as Strapdown

__all__ = [
    "PlanarStrapdown",
    "Strapdown",
    "double_sided",
    "single_sided",
]
