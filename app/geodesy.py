"""From longitude and latitude to building metres, by the plane that touches the Earth at the building's anchor.

The Earth is the WGS 84 ellipsoid (NGA.STND.0036). A position goes to Earth-centred axes and from there to east, north
and up at the anchor: IOGP Publication 373-7-2, "Geographic/topocentric conversions" (EPSG method 9837). Within 500 m
the plane differs from distances on the ground by less than a micrometre; within 10 km by less than 5 mm.
"""

from dataclasses import dataclass

import numpy as np

from app.geometry import Array

__all__ = ["Anchor", "building_from_wgs84", "east_north_up_m"]

SEMI_MAJOR_AXIS_M = 6_378_137.0
FLATTENING = 1 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2 - FLATTENING)


@dataclass(frozen=True, slots=True)
class Anchor:
    """Where the building frame's origin lies: ellipsoidal height; `bearing_deg` of +x, clockwise from true north."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    bearing_deg: float


def building_from_wgs84(lon_lat_deg: Array, anchor: Anchor) -> Array:
    """Positions [longitude, latitude] (n, 2) in degrees, taken at the anchor's height, to x, y (n, 2) in building m.

    A storey 20 m above the anchor errs by 20 m / 6,400 km of the distance: 1.6 mm at 500 m.
    """
    east, north = east_north_up_m(lon_lat_deg, anchor.height_m, anchor)[:, :2].T
    bearing_rad = np.radians(anchor.bearing_deg)
    s, c = np.sin(bearing_rad), np.cos(bearing_rad)
    return np.column_stack([s * east + c * north, s * north - c * east])


def east_north_up_m(lon_lat_deg: Array, height_m: float, anchor: Anchor) -> Array:
    """Positions (n, 2) in degrees at one ellipsoidal height in m, to metres east, north and up of the anchor (n, 3)."""
    here = np.array([[anchor.longitude_deg, anchor.latitude_deg]])
    off_m = _earth_centred_m(lon_lat_deg, height_m) - _earth_centred_m(here, anchor.height_m)
    lon, lat = np.radians(here[0])
    east = [-np.sin(lon), np.cos(lon), 0.0]
    north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
    up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    return np.asarray(off_m @ np.array([east, north, up]).T)


def _earth_centred_m(lon_lat_deg: Array, height_m: float) -> Array:
    lon, lat = np.radians(np.asarray(lon_lat_deg, dtype=np.float64)).T
    prime_vertical_m = SEMI_MAJOR_AXIS_M / np.sqrt(1 - ECCENTRICITY_SQUARED * np.sin(lat) ** 2)
    across = (prime_vertical_m + height_m) * np.cos(lat)
    along = ((1 - ECCENTRICITY_SQUARED) * prime_vertical_m + height_m) * np.sin(lat)
    return np.column_stack([across * np.cos(lon), across * np.sin(lon), along])
