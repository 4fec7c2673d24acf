"""The type of functions that take messages for the user."""

from __future__ import annotations

from collections.abc import Callable

Log = Callable[[str], None]
"""Take one line for the user."""
