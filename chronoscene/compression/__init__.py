"""Compression of a model's tensors: quantised, sorted, entropy coded. Reading trusts no file.

Works on NumPy arrays and knows no method.
"""
