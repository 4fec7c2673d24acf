"""Optimisers: Adam of whole tensors, and of the rows that a step saw."""
