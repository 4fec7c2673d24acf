"""From folders of photos to `Inputs`: images with names, periods and GPS positions."""
