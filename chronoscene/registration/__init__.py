"""Several captures of one place, years apart, in one COLMAP frame, and how well that went."""
