"""What rules compute: names, image files, photo metadata, observations, reprojection, frames."""
