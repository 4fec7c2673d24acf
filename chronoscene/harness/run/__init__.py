"""Execution of planned runs: one after the other, several at a time, or on a Ray cluster."""
