"""The Earth's field against the model's published test values, and in the building's frame."""

from datetime import date, timedelta

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.earth_field import earth_field, field_in_building_uT
from app.errors import InvalidInput
from app.geodesy import Anchor

# Year, height km, latitude, longitude; X, Y, Z nT; dX, dY, dZ nT a year. From WMM2025_TEST_VALUES.txt, NOAA/NCEI.
WMM_2025 = [
    (2025.0, 28, 89, -121, -255, -1482, 56194, 62.7, -21.2, 18.1),
    (2025.0, 65, 43, 93, 24300, 211, 50038, -3.9, -8.4, 60.4),
    (2025.0, 51, -33, 109, 21738, -2090, -52710, 32.2, 23.7, -3.3),
    (2025.0, 3, -50, -103, 19527, 10363, -31438, -31.4, -30.7, 89.0),
    (2025.0, 18, 0, 21, 29275, 660, -14317, -9.1, 15.4, 54.6),
    (2026.0, 74, -57, 3, 13268, -5498, -23576, 8.3, -13.7, 55.0),
    (2026.0, 83, 86, -46, 2582, -1528, 54279, 35.4, 53.4, 15.6),
    (2026.0, 34, -19, 43, 19526, -5224, -26183, 36.9, -59.4, -44.0),
    (2027.0, 61, 59, -77, 10438, -3087, 54398, 69.6, 25.1, -67.6),
    (2027.0, 12, -63, 178, 6234, 9925, -61076, -11.7, 39.7, 69.3),
    (2028.0, 95, 14, 65, 36932, -330, 11601, 29.1, 7.4, 17.5),
    (2028.0, 1, -76, -75, 16994, 9761, -42480, -5.1, -36.9, 81.0),
    (2029.0, 58, 32, 19, 29359, 2108, 30508, 8.5, 29.7, 41.2),
    (2029.0, 50, 87, -154, 258, -869, 55992, 41.6, -53.3, 13.4),
]
# The same of WMM2020testvalues.pdf, to a tenth.
WMM_2020 = [
    (2020.0, 0, 80, 0, 6570.4, -146.3, 54606.0, -16.2, 59.0, 42.9),
    (2020.0, 0, 0, 120, 39624.3, 109.9, -10932.5, 24.2, -60.8, 49.2),
    (2020.0, 100, -80, 240, 5744.9, 14799.5, -49969.4, 28.0, 1.4, 85.6),
]


@pytest.mark.parametrize(("row", "tolerance_nT"), [(row, 0.5) for row in WMM_2025] + [(row, 0.06) for row in WMM_2020])
def test_values_published_with_the_model(row: tuple[float, ...], tolerance_nT: float) -> None:
    year, height_km, latitude, longitude, *expected = row
    field = earth_field(latitude, longitude, 1e3 * height_km, date(int(year), 1, 1))
    got = 1e3 * np.array([field.north_uT, field.east_uT, field.down_uT])
    np.testing.assert_allclose(got, expected[:3], atol=tolerance_nT + 1e-6)
    np.testing.assert_allclose(1e3 * np.array(field.yearly_change_uT), expected[3:], atol=0.06)
    assert field.model == f"WMM-{2025 if year >= 2025 else 2020}"
    assert field.valid


def test_ann_arbor_by_height_above_sea_level() -> None:
    """Kuevor's 53.1351 uT (L508, L1605) is that of 270 m above sea level: 236 m above the ellipsoid, where the geoid
    lies 34 m below it (Kuevor, B19)."""
    on = date(2022, 9, 1)
    above_sea = earth_field(42.294431, -83.710442, 270.0 - 34.0, on)
    assert above_sea.magnitude_uT == pytest.approx(53.1351, abs=0.00005)
    assert above_sea.model == "WMM-2020"
    assert np.degrees(above_sea.declination_rad) == pytest.approx(-7.052, abs=0.001)
    assert np.degrees(above_sea.inclination_rad) == pytest.approx(68.72, abs=0.01)
    assert earth_field(42.294431, -83.710442, 270.0, on).magnitude_uT == pytest.approx(53.13414, abs=0.00001)


def test_a_date_after_the_last_model_is_carried_on_and_said() -> None:
    field = earth_field(48.0, 11.0, 500.0, date(2031, 6, 1))
    assert field.model == "WMM-2025"
    assert not field.valid
    assert field.valid_until == date(2030, 1, 1)


def test_where_a_compass_tells_nothing() -> None:
    assert not earth_field(86.0, 142.0, 0.0, date(2026, 1, 1)).compass
    assert earth_field(48.0, 11.0, 0.0, date(2026, 1, 1)).compass


@pytest.mark.parametrize(
    ("place", "where"),
    [((91.0, 0.0, 0.0), "latitude_deg"), ((0.0, 361.0, 0.0), "longitude_deg"), ((0.0, 0.0, 1e6), "height_m"),
     ((float("nan"), 0.0, 0.0), "latitude_deg")],
)  # fmt: skip
def test_places_off_the_earth(place: tuple[float, float, float], where: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        earth_field(*place, date(2026, 1, 1))
    assert caught.value.faults[0].location == where


def test_the_last_day_of_the_calendar() -> None:
    assert not earth_field(48.0, 11.0, 0.0, date(9999, 12, 31)).valid


def test_before_the_models() -> None:
    with pytest.raises(InvalidInput, match="2010"):
        earth_field(0.0, 0.0, 0.0, date(2009, 12, 31))


@given(bearing=st.floats(-360, 360), latitude=st.floats(-80, 80), longitude=st.floats(-180, 180))
def test_the_building_frame_turns_the_field(bearing: float, latitude: float, longitude: float) -> None:
    """Its magnitude stays, its vertical is up, and +x points to `bearing` from true north: facing magnetic north, y is
    zero and x positive."""
    field = earth_field(latitude, longitude, 0.0, date(2026, 1, 1))
    turned = field_in_building_uT(field, Anchor(latitude, longitude, 0.0, bearing))
    assert np.linalg.norm(turned) == pytest.approx(field.magnitude_uT)
    assert turned[2] == -field.down_uT
    to_north = field_in_building_uT(field, Anchor(latitude, longitude, 0.0, float(np.degrees(field.declination_rad))))
    np.testing.assert_allclose(to_north[:2], [field.horizontal_uT, 0.0], atol=1e-9)


@given(days=st.integers(0, 365 * 5 - 1))
def test_the_field_changes_slowly(days: int) -> None:
    on = date(2025, 1, 1) + timedelta(days)
    first = earth_field(51.0, 0.0, 0.0, date(2025, 1, 1))
    later = earth_field(51.0, 0.0, 0.0, on)
    assert later.valid
    expected = np.array([first.north_uT, first.east_uT, first.down_uT]) + days / 365.25 * np.array(
        first.yearly_change_uT
    )
    np.testing.assert_allclose([later.north_uT, later.east_uT, later.down_uT], expected, atol=1e-3)
