"""What is told of a device, and how sceptical the filter is: `AttitudeOptions`, and the samples it reads.

Noise is told twice where it is correlated in time, as most is: the sd of one sample, and a correlation time. A stream
faster than its correlation time then learns no more from being sampled faster.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from app.errors import Fault, InvalidInput
from app.geometry import Array

__all__ = ["AttitudeOptions", "InertialSamples", "Tuning", "tuning_of"]


POSITIVE = (
    "gyro_noise_rad_per_sqrt_s", "speed_m_per_s", "accelerometer_m_per_s2", "gravity_m_per_s2", "magnetometer_uT",
    "disturbance_memory_s", "new_field_s",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class AttitudeOptions:
    """Standard deviations per axis, and times; the defaults suit phones and body sensors.

    Gyro: white noise density, random walk of the bias (Kuevor's sigma_v, sigma_u), bias at the start, error in scale as
    a fraction of the rate, and the group delay of its low-pass filter, by which the attitude told leads the readings
    (2.5 ms is what common chips state for bandwidths near 200 Hz). `gyro_gap_s`: a sample holds this long; beyond it
    the rate is unknown with `unknown_rate_rad_per_s`.

    translation "bounded" integrates the accelerometer to a velocity which is known to stay small (`speed_m_per_s`,
    forgotten over `speed_correlation_s`), so that what pulls over a second cancels when it stops; "ignored" takes every
    sample for gravity, as Kuevor does, with `accelerometer_m_per_s2` of error.

    Magnetometer: white noise per sample; `field_uT` of field that changes over `field_correlation_s` as one moves;
    random walk of a learned field; hard iron at the start; a delay against the gyro. `learn_hard_iron`: open the hard
    iron again when the field does not fit. `weigh_disturbances`: add what strength and dip show to be wrong to the
    noise.

    Gates are chi-square quantiles with three degrees of freedom (14.16: 3 sigma, Brommer L175). A sensor rejected
    without pause for `recovery_s` is believed again: the attitude is set from it. Where the field's strength or dip is
    wrong too, the fault is the field's: a known one is waited for, a learned one learned anew after `new_field_s`,
    with north where it was.
    """

    gyro_noise_rad_per_sqrt_s: float = 1.5e-4
    gyro_bias_walk_rad_per_s_sqrt_s: float = 2e-5
    gyro_bias_rad_per_s: float = 0.01
    gyro_scale: float = 0.003
    gyro_delay_s: float = 0.0025
    gyro_gap_s: float = 0.25
    unknown_rate_rad_per_s: float = 1.0
    translation: Literal["bounded", "ignored"] = "bounded"
    speed_m_per_s: float = 0.7
    speed_correlation_s: float = 1.0
    accelerometer_noise_m_per_s_sqrt_s: float = 0.1
    accelerometer_m_per_s2: float = 0.5
    accelerometer_correlation_s: float = 0.1
    accelerometer_gate: float = 21.1
    gravity_m_per_s2: float = 9.81
    magnetometer_uT: float = 0.7
    field_uT: float = 2.0
    field_correlation_s: float = 5.0
    field_walk_uT_per_sqrt_s: float = 0.05
    hard_iron_uT: float = 0.3
    hard_iron_walk_uT_per_sqrt_s: float = 0.01
    learn_hard_iron: bool = True
    weigh_disturbances: bool = True
    magnetometer_delay_s: float = 0.005
    magnetometer_gate: float = 21.1
    disturbed_uT: float = 4.0
    disturbance_memory_s: float = 2.0
    rest_detection: bool = True
    rest_gyro_rad_per_s: float = 0.035
    rest_accelerometer_m_per_s2: float = 0.3
    rest_after_s: float = 1.5
    rest_rate_rad_per_s: float = 5e-4
    rest_largest_bias_rad_per_s: float = 0.035
    recovery_s: float = 5.0
    new_field_s: float = 30.0


class Tuning(NamedTuple):
    """`AttitudeOptions` as the compiled kernel takes them: numbers alone, in the same units."""

    gyro_noise: float
    bias_walk: float
    gyro_scale: float
    gyro_delay: float
    gyro_gap: float
    unknown_rate: float
    bounded: bool
    speed: float
    speed_correlation: float
    force_noise: float
    gravity_sd: float
    gravity_correlation: float
    accelerometer_gate: float
    gravity: float
    reading: float
    field: float
    field_correlation: float
    field_walk: float
    hard_iron: float
    hard_iron_walk: float
    learn_hard_iron: bool
    weigh_disturbances: bool
    delay: float
    magnetometer_gate: float
    disturbed: float
    memory: float
    rest: bool
    rest_gyro: float
    rest_force: float
    rest_after: float
    rest_rate: float
    rest_bias: float
    recovery: float
    new_field: float


def tuning_of(options: AttitudeOptions) -> Tuning:
    """The same numbers; raises InvalidInput where one is negative or not finite, or zero where that means certainty."""
    o = options
    numbers = {name: getattr(o, name) for name in o.__dataclass_fields__ if name != "translation"}
    for name, value in numbers.items():
        if not (np.isfinite(value) and value >= 0.0):
            message = f"options.{name} is {value}: give a finite number that is not negative"
            raise InvalidInput(message, Fault(f"/options/{name}", "negative or not finite"))
        if value == 0.0 and name in POSITIVE:
            message = f"options.{name} is zero: no sensor is certain and no time is none, give a small number"
            raise InvalidInput(message, Fault(f"/options/{name}", "zero"))
    return Tuning(
        o.gyro_noise_rad_per_sqrt_s, o.gyro_bias_walk_rad_per_s_sqrt_s, o.gyro_scale, o.gyro_delay_s, o.gyro_gap_s,
        o.unknown_rate_rad_per_s, o.translation == "bounded", o.speed_m_per_s, o.speed_correlation_s,
        o.accelerometer_noise_m_per_s_sqrt_s, o.accelerometer_m_per_s2, o.accelerometer_correlation_s,
        o.accelerometer_gate, o.gravity_m_per_s2, o.magnetometer_uT, o.field_uT, o.field_correlation_s,
        o.field_walk_uT_per_sqrt_s, o.hard_iron_uT, o.hard_iron_walk_uT_per_sqrt_s, o.learn_hard_iron,
        o.weigh_disturbances, o.magnetometer_delay_s, o.magnetometer_gate, o.disturbed_uT, o.disturbance_memory_s,
        o.rest_detection, o.rest_gyro_rad_per_s, o.rest_accelerometer_m_per_s2, o.rest_after_s, o.rest_rate_rad_per_s,
        o.rest_largest_bias_rad_per_s, o.recovery_s, o.new_field_s,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class InertialSamples:
    """Three streams on one axis of time; a row of NaN where a sensor has no sample at that time.

    t_s (n,), increasing; in the body's axes, each (n, 3): gyro_rad_per_s; accelerometer_m_per_s2, specific force, so
    that a body at rest reads +g upwards; magnetometer_uT.
    """

    t_s: Array
    gyro_rad_per_s: Array
    accelerometer_m_per_s2: Array
    magnetometer_uT: Array

    def __post_init__(self) -> None:
        """Raise InvalidInput for shapes that differ, times that do not increase, or rows part NaN, part number."""
        t = self.t_s
        if t.ndim != 1 or not np.all(np.isfinite(t)) or np.any(np.diff(t) <= 0.0):
            raise InvalidInput("t_s must be finite and increase: sort the samples", Fault("/t_s", "not increasing"))
        for name in ("gyro_rad_per_s", "accelerometer_m_per_s2", "magnetometer_uT"):
            rows = getattr(self, name)
            if rows.shape != (len(t), 3):
                message = f"{name} has shape {rows.shape}: give one row of three for each of {len(t)} times"
                raise InvalidInput(message, Fault(f"/{name}", "shape"))
            if np.any(np.isinf(rows)):
                message = f"{name} holds an infinite number: give NaN where there is no sample"
                raise InvalidInput(message, Fault(f"/{name}", "infinite"))

    def __len__(self) -> int:
        return len(self.t_s)
