"""Planning: the user's settings and scenes go in, checked runs as data come out."""
