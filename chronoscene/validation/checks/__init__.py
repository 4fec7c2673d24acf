"""Quantities that several rules derive from a scene: dates and positions, reprojection errors."""
