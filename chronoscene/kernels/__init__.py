"""What compiled kernels are made of: vectors and their memory, vector functions and matrix
products, how functions are compiled, and the threads that run them.

`runtime` sets up the process and needs neither Numba nor torch to be imported.
"""
