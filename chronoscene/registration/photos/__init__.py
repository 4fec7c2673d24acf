"""From folders of photos to `PhotoInputs`: images with names, periods and GPS positions."""
