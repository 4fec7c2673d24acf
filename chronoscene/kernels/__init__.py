"""Building blocks of compiled kernels: SIMD vectors, memory, matrix products, layers, threads.

What this stands on, and what may break with another version of Numba or llvmlite:

- `compilation`: the cache of `numba.njit` (``_cache._cache_file._source_stamp`` and
  ``_load_index``). Where these are missing, kernels still run but may be stale after an edit.
- `vectors`: `numba.extending` (`intrinsic`, `register_model`, `type_callable`, `lower_builtin`)
  and llvmlite's IR builder with typed pointers; names of LLVM intrinsics, of which
  ``llvm.x86.*pmadd*`` alone belong to one kind of processor.
- `memory`: ``context.make_array`` for the address of an array; ``llvm.masked.*`` and
  ``llvm.prefetch`` with names for opaque pointers (``.p0``).
- `thread_pool`: compiled functions that release Python's lock, and ``sched_yield``.

``tests/kernels`` compares each with NumPy; run it after an update of Numba. Kernels that use none
of these (synth, realtime4DGS, Adam) are plain Numba.

`runtime` sets up the process and needs neither Numba nor torch to be imported.
"""
