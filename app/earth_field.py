"""The Earth's main field at a place and date: the World Magnetic Model (NOAA/NCEI and BGS), by pygeomag.

A model serves the five years from its epoch and is best at its start; the one of the date is taken: WMM-2025 until the
end of 2029, WMM-2020, WMM-2015v2 and WMM-2010 before. Heights are above the WGS 84 ellipsoid: a height above sea level
needs the geoid's undulation added (Kuevor's 270 m at Ann Arbor are 236 m of ellipsoidal height, and 0.9 nT).
"""

from calendar import isleap
from dataclasses import dataclass
from datetime import date
from functools import lru_cache

import numpy as np
from pygeomag import GeoMag
from pygeomag.wmm.wmm_2010 import WMM_2010
from pygeomag.wmm.wmm_2015v2 import WMM_2015v2
from pygeomag.wmm.wmm_2020 import WMM_2020
from pygeomag.wmm.wmm_2025 import WMM_2025

from app.errors import Fault, InvalidInput
from app.geodesy import Anchor
from app.geometry import UT_PER_NANOTESLA, Array

__all__ = ["EarthField", "earth_field", "field_in_building_uT"]

LIFE_YEARS = 5
_MODELS = {2010: WMM_2010, 2015: WMM_2015v2, 2020: WMM_2020, 2025: WMM_2025}
_UNCERTAIN_NT = {2025: (133.0, 141.0, 138.0), 2020: (128.0, 157.0, 148.0)}  # h, z, f: the models' technical reports
_LOWEST_M, _HIGHEST_M = -1_000.0, 850_000.0  # that the model is made for
_WEAK_NT = 2_000.0  # horizontal: the blackout zone, where a compass tells nothing


@dataclass(frozen=True, slots=True)
class EarthField:
    """North, east and down in uT; the yearly change of each; and sds of what the model leaves out (crust, storms).

    model          "WMM-2025"
    valid          whether the date lies in the model's five years; outside, the nearest model is carried on
    compass        whether the horizontal field is strong enough for a compass (2 uT, the model's blackout zone)
    """

    model: str
    valid_from: date
    valid_until: date
    on: date
    valid: bool
    north_uT: float
    east_uT: float
    down_uT: float
    yearly_change_uT: tuple[float, float, float]
    horizontal_sd_uT: float
    down_sd_uT: float
    magnitude_sd_uT: float

    @property
    def horizontal_uT(self) -> float:
        return float(np.hypot(self.north_uT, self.east_uT))

    @property
    def magnitude_uT(self) -> float:
        return float(np.hypot(self.horizontal_uT, self.down_uT))

    @property
    def declination_rad(self) -> float:
        """Of magnetic from true north, eastward."""
        return float(np.arctan2(self.east_uT, self.north_uT))

    @property
    def inclination_rad(self) -> float:
        """Of the field below the horizon."""
        return float(np.arctan2(self.down_uT, self.horizontal_uT))

    @property
    def compass(self) -> bool:
        return self.horizontal_uT >= _WEAK_NT * UT_PER_NANOTESLA


@lru_cache(maxsize=1024)
def earth_field(latitude_deg: float, longitude_deg: float, height_m: float, on: date) -> EarthField:
    """The field at a place, at `height_m` above the WGS 84 ellipsoid.

    Raises InvalidInput for a place off the Earth, a height below -1 km or above 850 km, and a date before 2010.
    """
    _check(latitude_deg, longitude_deg, height_m, on)
    epoch = max(year for year in _MODELS if year <= max(on.year, min(_MODELS)))
    coefficients = _MODELS[epoch]
    model = GeoMag(coefficients_data=coefficients)
    decimal_year = on.year + (on - date(on.year, 1, 1)).days / (366 if isleap(on.year) else 365)

    def at(year: float) -> Array:
        told = model.calculate(latitude_deg, longitude_deg, 1e-3 * height_m, year, allow_date_outside_lifespan=True)
        return UT_PER_NANOTESLA * np.array([told.x, told.y, told.z])

    now = at(decimal_year)
    change = at(decimal_year + 0.5) - at(decimal_year - 0.5)
    h_nT, z_nT, f_nT = _UNCERTAIN_NT.get(epoch, _UNCERTAIN_NT[2020])
    return EarthField(
        model=coefficients[0][1],
        valid_from=date(epoch, 1, 1),
        valid_until=date(epoch + LIFE_YEARS, 1, 1),
        on=on,
        valid=epoch <= decimal_year <= epoch + LIFE_YEARS,
        north_uT=float(now[0]),
        east_uT=float(now[1]),
        down_uT=float(now[2]),
        yearly_change_uT=(float(change[0]), float(change[1]), float(change[2])),
        horizontal_sd_uT=h_nT * UT_PER_NANOTESLA,
        down_sd_uT=z_nT * UT_PER_NANOTESLA,
        magnitude_sd_uT=f_nT * UT_PER_NANOTESLA,
    )


def field_in_building_uT(field: EarthField, anchor: Anchor) -> Array:
    """(3,) the field in the building frame, z up, by the bearing of the building's +x from true north."""
    bearing_rad = np.radians(anchor.bearing_deg)
    s, c = np.sin(bearing_rad), np.cos(bearing_rad)
    return np.array([s * field.east_uT + c * field.north_uT, s * field.north_uT - c * field.east_uT, -field.down_uT])


def _check(latitude_deg: float, longitude_deg: float, height_m: float, on: date) -> None:
    faults = []
    if not abs(latitude_deg) <= 90.0:
        faults.append(Fault("latitude_deg", f"{latitude_deg:g} is not within -90 to 90"))
    if not abs(longitude_deg) <= 360.0:
        faults.append(Fault("longitude_deg", f"{longitude_deg:g} is not within -360 to 360"))
    if not _LOWEST_M <= height_m <= _HIGHEST_M:
        faults.append(Fault("height_m", f"{height_m:,.0f} m is outside the model's -1,000 to 850,000 m"))
    if on.year < min(_MODELS):
        faults.append(Fault("date", f"{on} is before {min(_MODELS)}, where the oldest model kept begins"))
    if faults:
        raise InvalidInput(f"the Earth's field is not known there: {faults[0].reason}", *faults)
