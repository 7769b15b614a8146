"""The reader of phone traces against walks that are known exactly."""

import numpy as np

from app.survey.read import read_survey


def read(data):
    return read_survey(data, format="indoor-location-2020")


def truth_at(known, walk, columns):
    start = known.t_s[np.searchsorted(known.t_s, 0.0)]
    return np.stack([np.interp(walk.samples.t_s + start, known.t_s, c) for c in columns.T], axis=1)


def test_positions_are_right_to_a_few_decimetres(known_walk):
    walk = read(known_walk.data)
    error = np.linalg.norm(walk.samples.p_building_m[:, :2] - truth_at(known_walk, walk, known_walk.p_m), axis=1)
    print(error.max(), np.median(error))
    assert np.median(error) < 0.25
    assert error.max() < 0.7
