"""A model's tensors in few bytes: quantised, sorted, entropy coded; and back, from files that
nobody vouches for. Works on NumPy arrays and knows no method."""
