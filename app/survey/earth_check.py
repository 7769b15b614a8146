"""A walk against the Earth's field where it was taken: wrong units, turned axes and hard iron left in are named.

Steel bends the field of a building by a third and more at single places, yet hardly in the mean of a walk. What is said
here is a warning, never a refusal: a walk along one steel wall may well look like this.
"""

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from app.field.samples import Samples
from app.geometry import Array, horizontal_and_vertical, wrap_angle_rad

__all__ = ["EarthCheck", "check_against_earth"]

STRONGER_SHARE = 0.35  # of the magnitude, by which a walk's median may be off before hard iron is suspected
DIP_OFF_RAD = np.radians(25.0)
YAW_OFF_RAD = np.radians(60.0)
STEEP_SHARE = 0.1  # of the magnitude that is horizontal: with less there is no direction to be off
AXES_GAIN = 0.5  # a turned set of axes is named when it leaves less than this part of the difference
_AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class EarthCheck:
    """`magnitude_uT` and `inclination_rad` of the walk (its median vector), beside the Earth's; and what is odd."""

    magnitude_uT: float
    earth_magnitude_uT: float
    inclination_rad: float | None
    earth_inclination_rad: float
    findings: tuple[str, ...]


def check_against_earth(samples: Samples, earth_uT: Array, *, bearing_known: bool) -> EarthCheck:
    """A walk against the Earth's field (3,) in the building frame, z up.

    `bearing_known`: whether that frame's x and y are those of the walk, so that directions can be compared as well.
    """
    earth_magnitude = float(np.linalg.norm(earth_uT))
    earth_dip = _dip_rad(earth_uT)
    if samples.frame == "norm":
        median = float(np.median(samples.B_uT))
        return EarthCheck(median, earth_magnitude, None, earth_dip, tuple(_magnitude(median, earth_magnitude)))
    median = float(np.median(np.linalg.norm(samples.B_uT, axis=1)))
    middle = _middle(samples)
    dip = _dip_rad(middle)
    findings = _magnitude(median, earth_magnitude)
    turned = _turned_axes(samples, middle, earth_uT, bearing_known)
    if turned is not None:
        findings.append(turned)
    elif abs(dip - earth_dip) > DIP_OFF_RAD:
        findings.append(
            f"the field dips {np.degrees(dip):.0f} deg below the horizon, the Earth's {np.degrees(earth_dip):.0f} deg "
            "here: the device was not level, or its hard iron was left in; calibrate it, or send its orientation"
        )
    elif samples.frame == "building" and bearing_known:
        findings += _yaw(middle, earth_uT)
    return EarthCheck(median, earth_magnitude, dip, earth_dip, tuple(findings))


def _middle(samples: Samples) -> Array:
    """(3,) the walk's typical field: level walks turn with the device, so that only their horizontal length counts."""
    if samples.frame == "building":
        return np.asarray(np.median(samples.B_uT, axis=0))
    horizontal, vertical = np.median(horizontal_and_vertical(samples.B_uT), axis=0)
    return np.array([horizontal, 0.0, vertical])


def _dip_rad(B_uT: Array) -> float:
    return float(np.arctan2(-B_uT[2], np.hypot(B_uT[0], B_uT[1])))


def _magnitude(median_uT: float, earth_uT: float) -> list[str]:
    off = median_uT / earth_uT - 1.0
    if abs(off) <= STRONGER_SHARE:
        return []
    return [
        f"a median |B| of {median_uT:.0f} uT is {abs(off):.0%} {'more' if off > 0 else 'less'} than the Earth's "
        f"{earth_uT:.0f} uT here: the sensor's hard iron was left in, or its scale is wrong; calibrate it "
        "(POST /v1/calibrations)"
    ]


def _turned_axes(samples: Samples, middle: Array, earth_uT: Array, bearing_known: bool) -> str | None:
    """Which signed exchange of axes would explain the walk far better than the axes it has."""
    flat = samples.frame != "building" or not bearing_known

    def off(B_uT: Array) -> float:
        if flat:  # its heading says nothing: horizontal length and vertical only
            return float(np.linalg.norm(horizontal_and_vertical(B_uT) - horizontal_and_vertical(earth_uT)))
        return float(np.linalg.norm(B_uT - earth_uT))

    as_is = off(middle)
    if as_is < np.sin(DIP_OFF_RAD) * float(np.linalg.norm(earth_uT)):
        return None
    best, name = as_is, None
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        if samples.frame == "level" and order != (0, 1, 2):
            continue  # the median horizontal length is no axis
        left = off(np.array(signs) * middle[list(order)])
        if left < best - 1e-9 and left < AXES_GAIN * as_is:
            best, name = left, _axes_name(order, signs, flat)
    return name


def _axes_name(order: tuple[int, ...], signs: tuple[float, ...], flat: bool) -> str:
    upright = order[2] == 2
    if upright and signs[2] < 0.0:
        which = "z looks inverted: it points down in the file (north-east-down?), and has to point up"
        advice = "negate y and z" if flat or signs[1] < 0.0 else "negate z"
        return f"{which}; {advice}"
    if not upright:
        sign = "" if signs[2] > 0.0 else "minus "
        return f"the axes look exchanged: {sign}{_AXES[order[2]]} is up, not z; send x, y along the floor and z up"
    told = ", ".join(f"{'-' if sign < 0 else ''}{_AXES[axis]}" for axis, sign in zip(order, signs, strict=True))
    return (
        f"the axes look turned in the plane: ({told}) would fit the Earth's field; check the orientation that was sent "
        "and the building's bearing_deg"
    )


def _yaw(middle: Array, earth_uT: Array) -> list[str]:
    if np.hypot(earth_uT[0], earth_uT[1]) < STEEP_SHARE * np.linalg.norm(earth_uT):
        return []
    off = float(wrap_angle_rad(np.arctan2(middle[1], middle[0]) - np.arctan2(earth_uT[1], earth_uT[0])))
    if abs(off) <= YAW_OFF_RAD:
        return []
    return [
        f"the horizontal field points {np.degrees(off):+.0f} deg from where it should (counter-clockwise): check the "
        "building's bearing_deg and the heading of the survey"
    ]
