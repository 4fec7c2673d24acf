"""Measurements of single methods."""
