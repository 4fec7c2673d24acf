"""Captures of one place, years apart, registered in one frame.

`photos.captures` finds the photos, `pipeline` runs the stages (photos, features, reconstruct, ties,
quality, report) and writes a scene with a certificate of how well its periods are aligned.
"""
