"""What rules compute: pixels, observations, reprojection, frames of periods, likeness of photos."""
