"""Measurements of speed, memory and accuracy; README.md lists them with their commands."""

# Before any script imports torch: it says how idle threads wait.
import chronoscene  # noqa: F401
