"""Sources of views: meshes to render, and published data sets in their authors' own formats."""
