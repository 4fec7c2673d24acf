"""What compiled kernels stand on: vectors, memory, products, threads, compilation."""
