"""Simulations of the statistics of reports."""
