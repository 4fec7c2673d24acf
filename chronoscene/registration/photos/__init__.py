"""From folders of photographs to images with names, periods, cameras and GPS positions."""
