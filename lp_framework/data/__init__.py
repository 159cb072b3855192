"""Data: meshes and their rendering, views on disk, what is computed from them once, and batches of pairs."""
