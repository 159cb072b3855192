"""Pages of finished runs: one self-contained HTML file each, drawn from what the runs left on disk."""
