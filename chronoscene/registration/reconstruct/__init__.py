"""From matches to one model of all periods, by one of three routes."""
