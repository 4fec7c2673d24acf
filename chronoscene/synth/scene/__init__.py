"""From renders to a dataset: flights, sparse points with tracks, ground truth."""
