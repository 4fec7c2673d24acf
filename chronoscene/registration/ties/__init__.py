"""Tie points that a person clicked: read, compared with a model, used to align it."""
