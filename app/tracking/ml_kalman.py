"""The tracker of Storms: a constant-velocity Kalman filter corrected by fixes from single readings (Storms 1.5-1.8).

Readings are in the building frame, since the heading is taken to be known (Storms, L530). Between readings the closed
form makes one step of any length, equal to many short ones. A turn command, if given, turns the velocity.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import chdtri

from app.geometry import Array
from app.tracking.kalman import (
    POSITION,
    GaussianBelief,
    condition_on_position,
    constant_velocity,
    predict,
    rotate_velocity,
    smooth,
    update,
    velocity_rotation,
)
from app.tracking.map_cells import MapCells
from app.tracking.position_fix import FixSettings, PositionFix, matched_fix, ml_fix

__all__ = ["Corrected", "MlKalman", "Track", "start_belief"]

_WIDER, _WIDENINGS = 4.0, 3


class Corrected(NamedTuple):
    """A belief after a reading, and the fix that corrected it: None where the map knows nothing."""

    belief: GaussianBelief
    fix: PositionFix | None


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Beliefs at the readings: mean (n, 4), covariance (n, 4, 4), and their fixes; `smoothed` has later ones too."""

    mean: Array
    covariance: Array
    fixes: tuple[PositionFix | None, ...]
    smoothed: Array

    @property
    def residual_m(self) -> Array:
        """(n, 2) fix minus the position *after* its update, as the source reports (Storms, L752); NaN without fix."""
        nowhere = np.full(2, np.nan)
        places = [nowhere if fix is None else fix.position_m for fix in self.fixes]
        return np.asarray(np.array(places).reshape(-1, 2) - self.mean[:, :2])


def start_belief(
    position_m: Array, velocity_m_s: Array, position_sd_m: float, velocity_sd_m_s: float
) -> GaussianBelief:
    """A first belief with independent errors; the source gives 1.5 m and no velocity sd (Storms, L804-819)."""
    variances = [position_sd_m**2] * 2 + [velocity_sd_m_s**2] * 2
    return GaussianBelief(np.concatenate([position_m, velocity_m_s]), np.diag(variances))


@dataclass(frozen=True, slots=True, eq=False)
class MlKalman:
    """A map, how fixes are made on it, and how a vehicle moves.

    `correct_by` "fix" is the source: the likeliest cell as a measurement. "moments" takes the posterior over cells as
    the updated position, in which the prior counts once (Storms 3, "prior counted twice"). `recover`, ours: where the
    likeliest cell does not fit the reading, the vehicle is not where it is believed to be, and the belief is widened
    until one does; a turn nobody told of is found that way.
    """

    cells: MapCells
    settings: FixSettings
    acceleration_psd_m2_s3: float
    correct_by: Literal["fix", "moments"] = "fix"
    recover: bool = False

    def advance(
        self, belief: GaussianBelief, dt_s: float, control_m_s2: Array | None = None, turn_rad: float = 0.0
    ) -> GaussianBelief:
        """Turn, then move for a time, under an acceleration command (2,) if there is one."""
        turned = rotate_velocity(belief, turn_rad) if turn_rad else belief
        return predict(turned, constant_velocity(dt_s, self.acceleration_psd_m2_s3), control_m_s2)

    def transition(self, dt_s: float, turn_rad: float = 0.0) -> Array:
        """(4, 4) of `advance`, for a smoother."""
        return constant_velocity(dt_s, self.acceleration_psd_m2_s3).transition @ velocity_rotation(turn_rad)

    def correct(self, belief: GaussianBelief, reading_uT: Array) -> Corrected:
        """Use one reading (c,), unless the map knows nothing here or a gate refuses the fix."""
        fix = self._fix(belief, reading_uT)
        for _ in range(_WIDENINGS if self.recover else 0):
            if fix is not None and _fits(fix, self.settings.gate_probability):
                break
            belief = GaussianBelief(belief.mean, _WIDER * belief.covariance)
            fix = self._fix(belief, reading_uT)
        if fix is None or fix.refused is not None:
            return Corrected(belief, fix)
        if self.correct_by == "fix":
            return Corrected(update(belief, fix.position_m, POSITION, fix.covariance_m2).belief, fix)
        return Corrected(condition_on_position(belief, fix.position_m, fix.covariance_m2), fix)

    def _fix(self, belief: GaussianBelief, reading_uT: Array) -> PositionFix | None:
        make = ml_fix if self.correct_by == "fix" else matched_fix
        return make(self.cells, reading_uT, belief.position_m, belief.position_covariance_m2, self.settings)

    def track(
        self, start: GaussianBelief, readings_uT: Array, dt_s: float, turns: Sequence[tuple[float, float]] = ()
    ) -> Track:
        """Beliefs at readings (n, c), the first `dt_s` after the start; `turns` are (time, s; angle, rad) commands."""
        beliefs, predicted, transitions = [start], [], []
        fixes = []
        for k, reading in enumerate(readings_uT):
            ahead, transition = self._between(beliefs[-1], k * dt_s, (k + 1) * dt_s, turns)
            corrected = self.correct(ahead, reading)
            predicted.append(ahead)
            transitions.append(transition)
            beliefs.append(corrected.belief)
            fixes.append(corrected.fix)
        later = smooth(beliefs, predicted, transitions)[1:]
        mean, covariance = np.array([b.mean for b in beliefs[1:]]), np.array([b.covariance for b in beliefs[1:]])
        return Track(mean, covariance, tuple(fixes), np.array([b.mean for b in later]))

    def _between(
        self, belief: GaussianBelief, from_s: float, to_s: float, turns: Sequence[tuple[float, float]]
    ) -> tuple[GaussianBelief, Array]:
        """The belief at a later time, turning on the way, and the transition (4, 4) that led there."""
        transition = np.eye(4)
        now_s, angle_rad = from_s, 0.0
        for at_s, turn_rad in [*(turn for turn in turns if from_s <= turn[0] < to_s), (to_s, 0.0)]:
            belief = self.advance(belief, at_s - now_s, turn_rad=angle_rad)
            transition = self.transition(at_s - now_s, angle_rad) @ transition
            now_s, angle_rad = at_s, turn_rad
        return belief, transition


def _fits(fix: PositionFix, probability: float) -> bool:
    return bool(fix.diagnostics.best_misfit <= chdtri(fix.diagnostics.components, probability))
