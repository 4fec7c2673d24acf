"""Measurements of speed, memory and accuracy; README.md lists them with their commands."""
