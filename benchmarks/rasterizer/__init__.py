"""Speed and accuracy of the CPU rasterizer."""
