"""Figures: predictions beside photos, between dates, after stages, and what periods share."""
