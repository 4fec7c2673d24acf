"""Gaussians in the files that other programs open: a `GaussianCloud` in, bytes out, and back."""
