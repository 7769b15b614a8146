"""What is known of a device and of the ground before it is followed."""

from dataclasses import dataclass

from app.tracking.ground import Ground

__all__ = ["StartPrior", "TrackOptions"]


@dataclass(frozen=True, slots=True)
class StartPrior:
    """Where the device is thought to be at its first step."""

    position_m: tuple[float, float, float]
    sd_m: float


@dataclass(frozen=True, slots=True)
class TrackOptions:
    """Parameters of the filter, all of them physical.

    noise_uT                     sd of the sensor's white noise, per axis
    bias_sd_uT                   of the sensor's constant offset, beyond what surveys of the map differ by
    step_scale_sd                relative sd of the scale of displacements, over the whole track
    heading_drift_sd_rad_per_m   sd of the rate by which the track's frame turns, over the whole track
    heading_walk_rad             sd of the heading's random walk, per square root of metre
    position_walk_m              sd of the position's random walk, per square root of metre
    course_sd_rad, course_m      sd of the direction walked about the one the device is held in, and the distance over
                                 which it stays alike
    scale_m                      distance over which the scale stays alike
    stray_nats_per_m             by which walking where nothing is mapped is less likely: people walk where surveyors
                                 walked (after the soft road penalty of Shockley, L1349)
    speed_m_s                    of a device that does not know how it moves: how fast it may be

    particles                    most particles; `least_particles` the fewest, between them the KLD bound decides
    update_m, update_rad         readings are averaged until the device has moved (a cell of the map at least) or turned
                                 this far
    window_m                     length of the windows that are searched for globally
    converged_probability        that the place said is right, for the state "converged"; below `lost_probability` a
                                 track that was converged is "lost"
    converged_radius_m           that the belief lies within, for the state "converged"
    lag_m                        distance walked after which a place is smoothed for good
    ground                       where one can walk, and where floors are joined
    """

    noise_uT: float = 0.5
    bias_sd_uT: float = 0.5
    step_scale_sd: float = 0.05
    heading_drift_sd_rad_per_m: float = 0.003
    heading_walk_rad: float = 0.015
    position_walk_m: float = 0.05
    course_sd_rad: float = 0.05
    course_m: float = 5.0
    scale_m: float = 100.0
    stray_nats_per_m: float = 0.5
    speed_m_s: float = 1.0

    particles: int = 20_000
    least_particles: int = 500
    update_m: float = 0.1
    update_rad: float = 0.3
    window_m: float = 15.0
    converged_probability: float = 0.95
    lost_probability: float = 0.7
    converged_radius_m: float = 2.5
    lag_m: float = 10.0
    ground: Ground | None = None
