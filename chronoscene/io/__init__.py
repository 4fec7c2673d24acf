"""Outside of this process: files that appear complete or not at all, processes, pycolmap."""
