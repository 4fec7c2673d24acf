"""Features, verified matches and held-out tracks of the photos, in COLMAP databases.

`matching` runs the steps; the others are what the worker process does in them.
"""

METHOD = "OpenCV RootSIFT 2"
"""How features and matches are computed. Change it when they come out differently: what earlier
versions computed is then not reused, because features of two kinds match each other less well."""
