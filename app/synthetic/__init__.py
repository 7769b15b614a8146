"""The analytic building: a world whose field is known everywhere, for tests, benchmarks and the demonstration."""

from app.synthetic.building import DEVICE_HEIGHT_M, SyntheticBuilding, make_building
from app.synthetic.noise import ornstein_uhlenbeck
from app.synthetic.sensors import Magnetometer, Pose, survey, survey_csv, window
from app.synthetic.steel import Bars, Cuboids, Dipoles
from app.synthetic.walks import SyntheticWalk, lawn_mower, random_waypoints

__all__ = [
    "DEVICE_HEIGHT_M",
    "Bars",
    "Cuboids",
    "Dipoles",
    "Magnetometer",
    "Pose",
    "SyntheticBuilding",
    "SyntheticWalk",
    "lawn_mower",
    "make_building",
    "ornstein_uhlenbeck",
    "random_waypoints",
    "survey",
    "survey_csv",
    "window",
]
