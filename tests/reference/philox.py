"""Twin of src/core/simulation/counter_noise: NumPy's own Philox is 4x64, so the 4x32-10 of the paper stands here."""

import numpy as np
from scipy.special import ndtri

MASK = 0xFFFFFFFF


def philox_4x32(counter, key):
    c, k = list(counter), list(key)
    for _ in range(10):
        a, b = 0xD2511F53 * c[0], 0xCD9E8D57 * c[2]
        c = [(b >> 32) ^ c[1] ^ k[0], b & MASK, (a >> 32) ^ c[3] ^ k[1], a & MASK]
        k = [(k[0] + 0x9E3779B9) & MASK, (k[1] + 0xBB67AE85) & MASK]
    return c


def normal_numbers(seed, stream, count):
    bits = [
        word
        for block in range((count + 3) // 4)
        for word in philox_4x32((block, 0, stream & MASK, stream >> 32), (seed & MASK, seed >> 32))
    ]
    return ndtri((np.array(bits[:count]) + 0.5) / 2**32)
