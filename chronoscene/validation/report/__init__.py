"""Outcome of a validation, for people and for programs."""
