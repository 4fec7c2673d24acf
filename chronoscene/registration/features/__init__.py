"""Features, verified matches and held-out tracks of the photos, in COLMAP databases.

`matching` runs the steps; the others are what the worker process does in them.
"""
