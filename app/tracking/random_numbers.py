"""Random numbers by counting: seed, step and particle give the same bits in any order (Salmon et al. 2011).

Philox 4x32 turns a counter of four words and a key of two into four random words; two pairs make four normals by
Box and Muller. No state is carried, so a loop over particles has no chain from one to the next, and compilers make it
vectors. Logarithm, sine and cosine are polynomials for the same reason; normals reach 6.6 sd. Words are the same
everywhere; normals may differ in the last bit between kinds of processors, for products are added without rounding.
"""

import math

import numba
import numpy as np
from numpy.typing import NDArray

__all__ = ["BLOCK", "Float32", "exp_of", "fill_normals", "log_of", "normals", "philox", "uniform"]

Float32 = NDArray[np.float32]

BLOCK = 512  # particles whose numbers are made at a time: they stay in the first cache
_ROUNDS = 7  # the fewest that pass BigCrush (Salmon et al. 2011, table 2)
_M0, _M1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_W0, _W1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_LOW, _HALF = np.uint64(0xFFFFFFFF), np.uint64(32)
_ONE = np.uint64(1)
_TO_UNIT = np.float32(2.0**-31)
_HALF_F = np.float32(0.5)
_LN2 = np.float32(math.log(2.0))
_SQRT_HALF = np.float32(math.sqrt(0.5))
_MANTISSA, _HALF_BITS, _EXPONENT = np.int32(0x007FFFFF), np.int32(0x3F000000), np.int32(126)
_SHIFT = np.int32(23)
_F1, _F2 = np.float32(1.0), np.float32(2.0)
_L = tuple(np.float32(v) for v in (
    7.0376836292e-2, -1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1,
    -1.6668057665e-1, 2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1,
))  # fmt: skip
"""log(1 + x) - x + x^2 / 2 over x^3 for sqrt(1/2) <= 1 + x < sqrt(2) (Moshier, Cephes, logf)."""
_E = tuple(np.float32(v) for v in (
    1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1,
))  # fmt: skip
"""exp(x) - 1 - x over x^2 for |x| <= log(2) / 2 (Moshier, Cephes, expf)."""
_LEAST, _LOG2E = np.float32(-87.0), np.float32(1.0 / math.log(2.0))
_LN2_HIGH, _LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
_TURN, _TO_QUARTER = np.float32(math.pi / 2.0), np.float32(2.0**-30)
_S = tuple(np.float32(v) for v in (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1))
_C = tuple(np.float32(v) for v in (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2))
"""Sine and cosine within an eighth of a turn (Moshier, Cephes, sinf and cosf)."""


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def philox(words, k0, k1, rounds):  # type: ignore[no-untyped-def]
    """Turn counters (4, k) of uint32 into as many random words, in place, with a key of two words in uint64."""
    for _ in range(rounds):  # round by round over all counters: this loop becomes vectors
        for i in range(words.shape[1]):
            p0, p1 = _M0 * np.uint64(words[0, i]), _M1 * np.uint64(words[2, i])
            words[0, i] = (p1 >> _HALF) ^ np.uint64(words[1, i]) ^ k0
            words[2, i] = (p0 >> _HALF) ^ np.uint64(words[3, i]) ^ k1
            words[1, i], words[3, i] = p1 & _LOW, p0 & _LOW
        k0, k1 = (k0 + _W0) & _LOW, (k1 + _W1) & _LOW


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def log_of(v):  # type: ignore[no-untyped-def]
    """Natural logarithm of a positive normal float32, to about an ulp."""
    bits = np.float32(v).view(np.int32)
    exponent = np.float32(np.int32((bits >> _SHIFT) - _EXPONENT))
    m = np.int32((bits & _MANTISSA) | _HALF_BITS).view(np.float32)
    low = m < _SQRT_HALF
    exponent -= _F1 if low else np.float32(0.0)
    x = (m + m if low else m) - _F1
    z = x * x
    y = _L[0] * x + _L[1]
    y = y * x + _L[2]
    y = y * x + _L[3]
    y = y * x + _L[4]
    y = y * x + _L[5]
    y = y * x + _L[6]
    y = y * x + _L[7]
    y = y * x + _L[8]
    return x + (y * x * z - _HALF_F * z) + exponent * _LN2


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def exp_of(v):  # type: ignore[no-untyped-def]
    """Exponential of a float32 not above zero, to about an ulp; below -87 it is that of -87, 1.6e-38."""
    v = max(np.float32(v), _LEAST)
    power = np.float32(np.floor(v * _LOG2E + _HALF_F))
    x = (v - power * _LN2_HIGH) - power * _LN2_LOW
    y = _E[0] * x + _E[1]
    y = y * x + _E[2]
    y = y * x + _E[3]
    y = y * x + _E[4]
    y = y * x + _E[5]
    y = (y * x * x + x) + _F1
    return y * np.float32(np.int32((np.int32(power) + np.int32(127)) << _SHIFT).view(np.float32))


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _pair(a, b):  # type: ignore[no-untyped-def]
    """Two normals of two words: a radius of 31 bits, a quadrant of two bits and an angle within it of 30."""
    u = (np.float32(np.int32(np.uint64(a) >> _ONE)) + _HALF_F) * _TO_UNIT
    radius = np.float32(math.sqrt(-_F2 * log_of(u)))
    quadrant = np.int32(np.uint64(b) & np.uint64(3))
    x = (np.float32(np.int32(np.uint64(b) >> np.uint64(2))) * _TO_QUARTER - _HALF_F) * _TURN
    z = x * x
    s = ((_S[0] * z + _S[1]) * z + _S[2]) * z * x + x
    c = ((_C[0] * z + _C[1]) * z + _C[2]) * z * z - _HALF_F * z + _F1
    swapped = (quadrant & np.int32(1)) != np.int32(0)
    radius *= _F1 - np.float32(np.int32(quadrant & np.int32(2)))
    return radius * (s if swapped else c), radius * (c if swapped else -s)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def fill_normals(out, words, first, step, seed):  # type: ignore[no-untyped-def]
    """Fill out (4, k) with the normals of k particles from `first` on; words (4, k) is scratch. Both contiguous."""
    for i in range(words.shape[1]):
        words[0, i], words[1, i] = first + i, 0
        words[2, i], words[3, i] = step & _LOW, step >> _HALF
    philox(words, seed & _LOW, seed >> _HALF, _ROUNDS)
    for i in range(words.shape[1]):
        out[0, i], out[1, i] = _pair(words[0, i], words[1, i])
        out[2, i], out[3, i] = _pair(words[2, i], words[3, i])


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def uniform(step, seed):  # type: ignore[no-untyped-def]
    """The one uniform of a step, in [0, 1); step and seed in uint64."""
    words = np.zeros((4, 1), dtype=np.uint32)
    words[1, 0], words[2, 0], words[3, 0] = 1, step & _LOW, step >> _HALF
    philox(words, seed & _LOW, seed >> _HALF, _ROUNDS)
    return ((np.uint64(words[0, 0]) << np.uint64(21)) ^ (np.uint64(words[1, 0]) >> np.uint64(11))) * 2.0**-53


def normals(count: int, step: int, seed: int) -> Float32:
    """(4, count) standard normals of a step, as the fused kernel draws them; step and seed below 2^64."""
    out = np.empty((4, count), dtype=np.float32)
    fill_normals(out, np.empty((4, count), dtype=np.uint32), 0, np.uint64(step), np.uint64(seed))
    return out
