"""Tie points and ground control: read, compared with a registration, used to align it."""
