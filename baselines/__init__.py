"""Plug-in methods that ChronoGS is compared with."""
