"""The smoother: better than either filter, and honest about it."""

from collections.abc import Callable

import numpy as np

from app.attitude.mekf import begin, follow_attitude
from app.attitude.options import AttitudeOptions
from app.attitude.reference import constant_reference, map_reference
from app.attitude.smooth import smooth_attitude

OPTIONS = AttitudeOptions(gyro_delay_s=0.0)


def test_it_beats_the_filter(tumble: Callable) -> None:
    ratios = []
    for seed in range(4):
        tumbled = tumble(seed=seed)
        reference = constant_reference(tumbled.field_uT)
        _, run = follow_attitude(begin(tumbled.samples, reference, OPTIONS), tumbled.samples, reference, OPTIONS)
        smoothed = smooth_attitude(tumbled.samples, reference, OPTIONS)
        ratios.append([np.square(tumbled.error_rad(each.q_body_to_building)).mean() for each in (smoothed, run)])
        assert np.all(np.linalg.eigvalsh(smoothed.covariance_rad2) > 0.0)
        assert np.all(
            np.trace(smoothed.covariance_rad2, axis1=1, axis2=2) <= np.trace(run.covariance_rad2, axis1=1, axis2=2)
        )
        assert np.abs(smoothed.gyro_bias_rad_per_s[-1] - run.gyro_bias_rad_per_s[-1]).max() < 1e-3
    ours, filtered = np.mean(ratios, axis=0)
    assert ours < 0.8 * filtered


def test_a_map_and_gaps_go_both_ways(tumble: Callable) -> None:
    tumbled = tumble(seed=5, seconds=20.0)
    n = len(tumbled.truth)
    tumbled.samples.magnetometer_uT[::2] = np.nan
    tumbled.samples.gyro_rad_per_s[700] = np.nan
    reference = map_reference(np.tile(tumbled.field_uT, (n, 1)), np.full((n, 3), 0.5))
    smoothed = smooth_attitude(tumbled.samples, reference, OPTIONS)
    error = np.linalg.norm(tumbled.error_rad(smoothed.q_body_to_building), axis=1)
    assert np.rad2deg(np.sqrt(np.mean(error**2))) < 1.5
