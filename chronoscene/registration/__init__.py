"""Captures of one place, years apart, registered in one frame.

`photos.captures` finds the photos. `pipeline` runs the stages (photos, features, reconstruct, ties,
quality, report) and writes a scene with a certificate of the alignment of its periods. Results of
the stages are kept in a work folder (`work_folder`).
"""
