"""Reports of finished runs: result tables beside the paper's numbers, and self-contained HTML pages."""
