"""How well a registration fits: measurements, certificate, verdict."""
