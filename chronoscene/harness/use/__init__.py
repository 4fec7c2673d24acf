"""Use of trained runs: cameras, rendering, export, compression, changes and leakage."""
