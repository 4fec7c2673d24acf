"""Scenes, the comparison of a backend with the reference, and the registry of extremes.

A package so that tests, `measure.py` and `benchmarks/rasterizer/extremes.py` share it: put its
folder on the path and import it.
"""
