"""Features and matches that the user has: files of hloc and COLMAP, and extractors of others."""
