"""Features, verified matches and held-out tracks of the photos, in COLMAP databases.

`correspondences` runs the steps `extraction` and `matching`, each in a process of its own.
"""

METHOD = "OpenCV RootSIFT 2"
"""How features and matches are computed. Change it when they come out differently: what earlier
versions computed is then not reused, because features of two kinds match each other less well."""
