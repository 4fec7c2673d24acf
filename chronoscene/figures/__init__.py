"""Figures and pages of scenes: counts by period, and point clouds coloured by period."""
