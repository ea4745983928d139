"""Pictures, depth and exact flow of a world. Only `raycast` and `shading` need MuJoCo."""
