"""Commands that train methods or use trained runs: one file per command."""
