"""A walk: what a survey file becomes."""

from dataclasses import dataclass

from app.field.samples import Samples
from app.geometry import Array

__all__ = ["DeadReckoning", "Walk"]


@dataclass(frozen=True, slots=True, eq=False)
class DeadReckoning:
    """What the device itself knew along the walk, without any label of position: one row per sample of the walk.

    The frame is the level frame of the first sample: x forward (the top edge of the device), y left, z up.

    displacement_m          (n, 3) from the first sample, from detected steps and the gyroscope (z is 0)
    yaw_rad                 (n,) yaw of the device since the first sample, from the gyroscope
    B_level_uT              (n, 3) field in each sample's own level frame, after the device's own bias was subtracted
    q_body_to_level         (n, 4) scalar-first attitude of the device in each sample's own level frame
    step_t_s                (k,) times at which steps ended
    step_length_m           (k,) modelled lengths of those steps
    heading_rad             (n,) yaw of each level frame in the building as the device believes it at that moment, from
                            this and earlier samples (None: it cannot know)
    heading_sd_rad          (n,) its standard deviation, walking direction included (None with heading_rad)
    bias_sd_uT              sd to expect, per axis, of the hard iron left in B_level_uT
    """

    displacement_m: Array
    yaw_rad: Array
    B_level_uT: Array
    q_body_to_level: Array
    step_t_s: Array
    step_length_m: Array
    heading_rad: Array | None
    heading_sd_rad: Array | None
    bias_sd_uT: float


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """A survey as read.

    samples            positions and field
    report             plain JSON: what was found, what the reader assumed, warnings, quality figures
    dead_reckoning     for formats that carry inertial sensors, else None
    """

    samples: Samples
    report: dict[str, object]
    dead_reckoning: DeadReckoning | None = None
