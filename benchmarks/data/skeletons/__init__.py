"""Skeletons: valid scenes of any size, with tiny images, for measuring tools."""
