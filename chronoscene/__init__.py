"""Dataset toolkit and benchmark harness for multi-period scene reconstruction."""

# Loaded before anything can import pycolmap: pycolmap 4.2.1 exports its own zlib symbols, and a
# process that loads it before the system's zlib aborts at its first compression.
import zlib as _zlib  # noqa: F401

__version__ = "0.1.0"
