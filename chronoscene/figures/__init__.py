"""Figures and pages of scenes: counts by period, and point clouds coloured by period.

Panels of quality against cost are drawn here, too, from plain numbers.
"""
