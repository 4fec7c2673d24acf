"""Corrected copies of scenes."""
