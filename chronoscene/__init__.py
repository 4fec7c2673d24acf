"""Dataset toolkit and benchmark harness for multi-period scene reconstruction."""

import os as _os

# Loaded before anything can import pycolmap: pycolmap 4.2.1 exports its own zlib symbols, and a
# process that loads it before the system's zlib aborts at its first compression.
import zlib as _zlib  # noqa: F401

# Numba tries TBB first and warns when it is too old; OpenMP also starts its threads quickest.
_os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")

__version__ = "0.1.0"
