"""Registrations whose truth is known."""
