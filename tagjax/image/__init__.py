"""Image operations: warps, census transform, median filter, edge-preserving smoothing."""
