"""Features, verified matches and held-out tracks of the photos, in COLMAP databases.

`correspondences` runs `extraction` and `matching` as tasks in processes of their own.
"""

METHOD = "OpenCV RootSIFT 3"
"""Name of the algorithms for features and matches. Change it when their results change: results of
earlier versions are then not reused, because features of two kinds match each other less well."""
