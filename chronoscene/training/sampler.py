"""Which training view comes next."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class ViewSampler:
    """Draws view indices without replacement from a shuffled pool that is refilled when empty.

    The order is a function of the seed and of the number of draws alone: pool number ``e`` is the
    permutation of a generator seeded with ``(seed, e)``. A resumed run sets `drawn` and goes on as
    if it had never stopped, and nothing else can disturb the order.

    Args:
        count: Number of views to draw from.
        seed: Seed of the run.
    """

    def __init__(self, count: int, seed: int) -> None:
        if count < 1:
            raise ValueError(f"count must be at least 1, not {count}")
        self.count = count
        self.seed = seed
        self.drawn = 0
        """Draws done so far; may be set to continue an interrupted run."""
        self._pool_number = -1
        self._pool: NDArray[np.int64] = np.zeros(0, np.int64)

    def next(self) -> int:
        """Index of the next view, 0..count-1."""
        pool_number, position = divmod(self.drawn, self.count)
        if pool_number != self._pool_number:
            generator = np.random.default_rng((self.seed, pool_number))
            self._pool = generator.permutation(self.count)
            self._pool_number = pool_number
        self.drawn += 1
        return int(self._pool[position])
