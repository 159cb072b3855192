"""View sources: meshes to render, and published data sets in their original formats."""
