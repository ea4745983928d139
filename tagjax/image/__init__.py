"""Image operations: warps."""
