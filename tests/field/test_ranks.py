"""Order statistics with each survey left out, against sorting the others anew."""

import numpy as np
import pytest

from app.field.ranks import ranked_without


@pytest.mark.parametrize("tied", [False, True])
def test_ranks_are_those_of_the_sorted_others(tied):
    rng = np.random.default_rng(3)
    values = [rng.normal(size=(n, 2)) for n in (40, 0, 7, 300, 1)]
    if tied:
        values = [np.round(2.0 * each) for each in values]
    others = [np.sort(np.concatenate([v for j, v in enumerate(values) if j != own]), axis=0) for own in range(5)]
    for share in (0.0, 0.5, 0.95):
        ranks = np.array([[int(share * (len(o) - 2)), int(share * (len(o) - 2)) + 1] for o in others])
        expected = np.stack([o[rank] for o, rank in zip(others, ranks, strict=True)])
        assert np.array_equal(ranked_without(values, ranks), expected)


def test_without_any_value_there_is_no_answer():
    assert np.isnan(ranked_without([np.zeros((0, 3))] * 2, np.zeros((2, 1), dtype=np.int64))).all()
