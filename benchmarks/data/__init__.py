"""Scenes with the sizes of the paper, and the time that dataset commands take on them."""
