"""Image files: decoding and the cache, metadata, resampling, undistorted cameras."""
