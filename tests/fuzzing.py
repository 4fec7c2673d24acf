"""What fuzz tests share: damaged bytes, a watch on opened files, and a loop over many cases.

A loop runs a fixed number of cases with the seeds 0, 1, ...; a failure names the seed of its case,
and an abort of the process ends pytest. ``CHRONOSCENE_FUZZ_SECONDS`` lets each loop go on for that
long, ``CHRONOSCENE_FUZZ_SEED`` is the first seed.
"""

import os
import random
import resource
import struct
import sys
import time
from contextlib import contextmanager

SECONDS = float(os.environ.get("CHRONOSCENE_FUZZ_SECONDS", "0"))
SEED = int(os.environ.get("CHRONOSCENE_FUZZ_SEED", "0"))

MAX_SECONDS = 10.0
"""Computing time of one case; a good one takes a hundredth."""

MAX_KILOBYTES = 1_000_000
"""Memory by which the process may grow in one case."""

NUMBERS = (0, 1, 2**31 - 1, 2**31, 2**32 - 1, 10**12, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
FLOATS = (float("nan"), float("inf"), -1e308, 1e308, 5e-324, 0.0, -0.0, 1e17)
WORDS = (b"nan", b"inf", b"-1", b"1e999", b"9" * 5000, b"../../outside/secret.png", b"\0")

opened: list[str] = []
"""Files that were opened although nobody should: outside of the scene, and pickles."""


def watch(event, arguments):
    if event == "open" and isinstance(arguments[0], str | bytes):
        name = os.path.normpath(os.fsdecode(arguments[0]))
        if name.endswith("0/outside/secret.png") or "cam_dict" in name:
            opened.append(name)


sys.addaudithook(watch)


def damage_bytes(rng, data):
    """A few random changes of some bytes."""
    data = bytearray(data)
    for _ in range(rng.choice([1, 1, 1, 2, 5, 20])):
        if not data:
            return rng.randbytes(rng.randrange(40))
        at = rng.randrange(len(data))
        words = bytes(data).split(b" ")
        words[rng.randrange(len(words))] = rng.choice(WORDS)
        start, end, new = rng.choice(
            [
                (at, at + 1, rng.randbytes(1)),
                (at, at + 1, bytes([data[at] ^ 1 << rng.randrange(8)])),
                (at, len(data), b""),
                (at, at + rng.randrange(1, 64), b""),
                (at, at, rng.randbytes(rng.randrange(1, 64))),
                (at, at, data[rng.randrange(len(data)) :][: rng.randrange(1, 200)]),
                (at, at + 8, struct.pack("<Q", rng.choice(NUMBERS))),
                (at, at + 8, struct.pack("<d", rng.choice(FLOATS))),
                (0, len(data), b" ".join(words)),
            ]
        )
        data[start:end] = new
    return bytes(data)


def many_cases(count, run):
    """Run cases, each with its own random numbers and within its limits."""
    end, seed = time.monotonic() + SECONDS, SEED
    while seed < SEED + count or time.monotonic() < end:
        began, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        opened.clear()
        try:
            run(random.Random(seed))
            assert time.process_time() - began < MAX_SECONDS
            assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MAX_KILOBYTES
            assert not opened
        except BaseException as error:
            error.add_note(f"CHRONOSCENE_FUZZ_SEED={seed}")
            raise
        seed += 1
    print(f"{seed - SEED} cases")  # shown by pytest -rP


@contextmanager
def damaged_files(rng, files, damage):
    """One or two of some files are damaged by a function of random numbers, path and content."""
    chosen = rng.sample(files, min(len(files), rng.choice([1, 1, 1, 2])))
    good = {path: path.read_bytes() for path in chosen}
    try:
        for path, data in good.items():
            path.write_bytes(damage(rng, path, data))
        yield
    finally:
        for path, data in good.items():
            path.write_bytes(data)
