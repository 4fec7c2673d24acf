"""COLMAP models on disk: read as they are, read for use, and written."""
