"""Random numbers keyed by names, so that adding one object leaves the others as they were."""

from __future__ import annotations

import zlib

import numpy as np


def rng_for(seed: int, *keys: object) -> np.random.Generator:
    """Generator for a named purpose; equal seed and keys give equal numbers on any machine."""
    words = [zlib.crc32(str(key).encode()) for key in keys]
    return np.random.default_rng(np.random.SeedSequence([seed, *words]))


def key_number(*keys: object) -> int:
    """Small positive integer of a name, for the hashes inside textures."""
    return zlib.crc32("/".join(map(str, keys)).encode()) % 65_521
