import numpy as np
import pytest

from app.field.triangular import inverse_of_lower


@pytest.mark.parametrize("m", [1, 5, 64, 65, 190, 301])
def test_the_inverse_by_halves_is_the_inverse(m):
    rng = np.random.default_rng(m)
    root = rng.normal(size=(m, m))
    factor = np.linalg.cholesky(root @ root.T + m * np.eye(m))
    garbage = factor + np.triu(rng.normal(size=(m, m)), 1)  # above the diagonal nothing is read
    assert np.allclose(np.tril(inverse_of_lower(np.asfortranarray(garbage))) @ factor, np.eye(m), atol=1e-12)
