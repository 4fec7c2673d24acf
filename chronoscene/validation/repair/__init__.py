"""Corrected copies of scenes: `fix_scene` writes them, `contents` corrects the files."""
