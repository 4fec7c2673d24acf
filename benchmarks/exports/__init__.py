"""Files of `chronoscene export` beside readers and a renderer that share no code with it."""
