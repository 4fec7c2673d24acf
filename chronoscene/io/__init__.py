"""Input and output: staged files and folders, tables, pages, messages, processes, pycolmap."""
