"""Other ways to rasterize, to compare ours with; written for these benchmarks alone.

Each module has ``NAME``, ``WHAT`` (one line for the table) and ``make(scene) -> function``: what
the function does is timed, and it returns the image. Modules raise `UnavailableError` with a reason
where they cannot run.
"""

from __future__ import annotations


class UnavailableError(Exception):
    """Raised with the reason if a peer cannot run here."""
