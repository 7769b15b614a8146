"""Longitude and latitude to building metres, against a published example and against Vincenty's geodesics."""

from math import atan2, cos, hypot, radians, sin, sqrt, tan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.geodesy import Anchor, building_from_wgs84, east_north_up_m

A, F = 6378137.0, 1 / 298.257223563
B = A * (1 - F)


def vincenty_m_rad(lon1: float, lat1: float, lon2: float, lat2: float) -> tuple[float, float]:
    """Length and initial azimuth of the geodesic between two positions in degrees (Vincenty 1975, inverse)."""
    u1, u2 = (np.arctan((1 - F) * tan(radians(lat))) for lat in (lat1, lat2))
    L = lam = radians(lon2 - lon1)
    for _ in range(50):
        x = cos(u2) * sin(lam)
        y = cos(u1) * sin(u2) - sin(u1) * cos(u2) * cos(lam)
        sin_s, cos_s = hypot(x, y), sin(u1) * sin(u2) + cos(u1) * cos(u2) * cos(lam)
        if sin_s == 0.0:
            return 0.0, 0.0
        s = atan2(sin_s, cos_s)
        sin_a = cos(u1) * cos(u2) * sin(lam) / sin_s
        cos2_a = 1 - sin_a**2
        cos_2m = cos_s - 2 * sin(u1) * sin(u2) / cos2_a if cos2_a > 1e-15 else 0.0
        c = F / 16 * cos2_a * (4 + F * (4 - 3 * cos2_a))
        lam = L + (1 - c) * F * sin_a * (s + c * sin_s * (cos_2m + c * cos_s * (2 * cos_2m**2 - 1)))
    uu = cos2_a * (A**2 - B**2) / B**2
    k1 = (sqrt(1 + uu) - 1) / (sqrt(1 + uu) + 1)
    a, b = (1 + k1**2 / 4) / (1 - k1), k1 * (1 - 3 * k1**2 / 8)
    inner = cos_s * (2 * cos_2m**2 - 1) - b / 6 * cos_2m * (4 * sin_s**2 - 3) * (4 * cos_2m**2 - 3)
    return B * a * (s - b * sin_s * (cos_2m + b / 4 * inner)), atan2(x, y)


def radius_m(latitude_deg: float, azimuth_rad: float) -> float:
    """The ellipsoid's radius of curvature in a direction (Euler)."""
    e2, sine = F * (2 - F), sin(radians(latitude_deg))
    prime = A / sqrt(1 - e2 * sine**2)
    meridian = prime * (1 - e2) / (1 - e2 * sine**2)
    return 1 / (cos(azimuth_rad) ** 2 / meridian + sin(azimuth_rad) ** 2 / prime)


@given(
    latitude=st.floats(-80, 80), longitude=st.floats(-180, 180), bearing=st.floats(-360, 360),
    height=st.floats(-400, 4000), north_m=st.floats(-350, 350), east_m=st.floats(-350, 350),
)  # fmt: skip
def test_distances_and_directions_are_those_of_geodesics(
    latitude: float, longitude: float, bearing: float, height: float, north_m: float, east_m: float
) -> None:
    """A building 500 m away in any direction: less than 1 mm off, also when raised to the anchor's height."""
    lat2 = latitude + north_m / 111_000
    lon2 = longitude + east_m / (111_000 * cos(radians(latitude)))
    length_m, azimuth = vincenty_m_rad(longitude, latitude, lon2, lat2)
    length_m *= 1 + height / radius_m(latitude, azimuth)
    from_x = radians(bearing) - azimuth  # bearings turn clockwise, headings counter-clockwise
    found = building_from_wgs84(np.array([[lon2, lat2]]), Anchor(latitude, longitude, height, bearing))[0]
    np.testing.assert_allclose(found, [length_m * cos(from_x), length_m * sin(from_x)], atol=1e-3)


def test_the_published_example_of_topocentric_coordinates() -> None:
    """IOGP Publication 373-7-2, the example of EPSG method 9837: 229 km away, so every term counts."""
    point = np.array([[2 + 7 / 60 + 46.380 / 3600, 53 + 48 / 60 + 33.820 / 3600]])
    found = east_north_up_m(point, 73.0, Anchor(55.0, 5.0, 200.0, 0.0))[0]
    np.testing.assert_allclose(found, [-189013.869, -128642.040, -4220.171], atol=2e-3)


@pytest.mark.parametrize(
    ("bearing", "north", "east"), [(0, (1, 0), (0, -1)), (90, (0, 1), (1, 0)), (180, (-1, 0), (0, 1))]
)
def test_the_bearing_is_that_of_x_clockwise_from_north(bearing: float, north: tuple, east: tuple) -> None:
    anchor = Anchor(48.0, 11.0, 0.0, bearing)
    to_north, to_east = building_from_wgs84(np.array([[11.0, 48.001], [11.001, 48.0]]), anchor)
    np.testing.assert_allclose(to_north / np.hypot(*to_north), north, atol=1e-5)
    np.testing.assert_allclose(to_east / np.hypot(*to_east), east, atol=1e-4)


def test_the_date_line_is_no_edge() -> None:
    found = building_from_wgs84(np.array([[-179.999, 0.0]]), Anchor(0.0, 179.999, 0.0, 90.0))[0]
    np.testing.assert_allclose(found, [0.002 * np.pi / 180 * A, 0.0], atol=1e-3)
