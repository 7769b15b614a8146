"""What a track is followed with, and all that changes along it."""

from dataclasses import dataclass, field

import numpy as np
from scipy.special import expit

from app.attitude.mekf import AttitudeState
from app.geometry import Array
from app.positioning.floors import SearchableFloor
from app.positioning.window import WindowFrame
from app.tracking.attitude import Attitude, AttitudeReference
from app.tracking.disturbance import PATIENCE_M
from app.tracking.estimate import Estimate, State, describe
from app.tracking.ground import Barriers
from app.tracking.no_map import NoMap
from app.tracking.options import StartPrior, TrackOptions
from app.tracking.particles import Particles
from app.tracking.places import Places
from app.tracking.recent import Recent
from app.tracking.smoother import Lag
from app.tracking.step import Step

__all__ = ["MOST_ODDS", "TrackState", "Tracker"]

MOST_ODDS = 7.0  # nats: evidence is not hoarded, so that a device that leaves the map is noticed


@dataclass(frozen=True, slots=True, eq=False)
class Tracker:
    """What stays the same along a track: maps, what is known of the device, and the seed."""

    floors: tuple[SearchableFloor, ...]
    places: Places
    barriers: Barriers
    frame: WindowFrame
    options: TrackOptions
    seed: int
    prior: StartPrior | None = None
    attitude: AttitudeReference | None = None

    @property
    def spacing_m(self) -> float:
        """Of readings: nearer ones meet the same cell of the map."""
        return max(self.options.update_m, float(self.places.resolution_m.min()))

    def describe(self, particles: Particles, weight: Array) -> Estimate:
        """The estimate of particles of normalised weights."""
        return describe(particles, weight, self.places.count, self.places.structure.position_sd_m**2)


@dataclass(frozen=True, slots=True, eq=False)
class TrackState:
    """Everything that changes.

    step            the last one followed
    samples         since the last reading: how many, and in `gathered` the sums of their place, time and field
    place_m         (3,) where the device last reckoned to be
    unseen_m        that it may have walked since the last reading without knowing how
    course_rad      (2,) direction of the path at its start and now, in the track's frame; NaN: not known yet
    particles       None while they are searched for
    log_odds        how much better the particles predict the readings than no map does, kept to MOST_ODDS
    gains           (k, 2) distance walked and log odds gained, of the readings in `recent`
    searched_m      path at the last search
    tells_height    whether the device ever said that it rose or sank
    estimate_from_m (3,) where the device reckoned to be when the estimate was made
    attitude, turned   of the attitude filter, where inertial samples are sent: its state, and what it says
    disturbed       whether the last reading was; patience_m: over how much of the way others may still be
    """

    step: Step | None = None
    samples: int = 0
    gathered: Array | None = None
    path_m: float = 0.0
    place_m: Array | None = None
    unseen_m: float = 0.0
    course_rad: tuple[float, float] = (np.nan, np.nan)
    course_from_m: Array | None = None
    recent: Recent = field(default_factory=Recent)
    particles: Particles | None = None
    lag: Lag | None = None
    no_map: NoMap | None = None
    log_odds: float = 0.0
    gains: tuple[tuple[float, float], ...] = ()
    searched_m: float = 0.0
    tells_height: bool = False
    state: State = "searching"
    estimate: Estimate | None = None
    estimate_from_m: Array | None = None
    converged_at_m: float | None = None
    disturbed: bool = False
    patience_m: float = PATIENCE_M
    attitude: AttitudeState | None = None
    turned: Attitude | None = None

    @property
    def probability(self) -> float:
        """That the particles follow the device."""
        return 0.0 if self.particles is None else float(expit(self.log_odds))
