"""Parts that several formats share. No format is imported here but our own."""
