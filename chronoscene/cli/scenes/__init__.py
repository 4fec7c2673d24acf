"""Commands on datasets: one file per command."""
