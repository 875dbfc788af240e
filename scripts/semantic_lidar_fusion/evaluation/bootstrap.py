# SPDX-License-Identifier: MIT
"""How sure a score is: intervals by block bootstrap over scans.

Neighbouring scans see the same things, so that scans drawn one by one would seem more certain than
they are: blocks of consecutive scans are drawn with replacement (moving block bootstrap, Kuensch
1989), as many as fill the drive, and the score is computed anew for each draw.
"""

from typing import Callable, Tuple

import numpy as np

BLOCK_SCANS = 10  # a second of a 10 Hz lidar
DRAWS = 1000
_LEVEL = 0.95


def interval(
    counts: np.ndarray,
    score: Callable[[np.ndarray], float],
    block: int = BLOCK_SCANS,
    draws: int = DRAWS,
    seed: int = 1,
) -> Tuple[float, float]:
    """The 95 % interval of score(sum of the counts of drawn scans).

    counts: (S, ...) of each scan, in order of time; score: of an array (...). NaN where there are
    fewer than two blocks of scans to draw from."""
    scans = len(counts)
    if scans < 2 * block:
        return float("nan"), float("nan")
    random = np.random.RandomState(seed)
    # Sums of all blocks that start at each scan but the last few.
    total = np.concatenate([np.zeros_like(counts[:1]), np.cumsum(counts, axis=0)])
    blocks = total[block:] - total[:-block]
    wanted = int(round(scans / block))
    values = []
    for _ in range(draws):
        chosen = random.randint(0, len(blocks), wanted)
        values.append(score(blocks[chosen].sum(axis=0)))
    low, high = np.nanpercentile(values, [50 * (1 - _LEVEL), 50 * (1 + _LEVEL)])
    return float(low), float(high)
