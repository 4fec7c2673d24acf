"""Studies: a question about a method as several runs, and the table that answers it."""
