"""How much of the mathematics the tests have run, a line a module; 1 where a module has less than `LEAST` of its lines.

Reads what `pytest --cov` left in .coverage; which modules count is in pyproject.toml, [tool.coverage].
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from coverage import Coverage

LEAST = 95.0  # per cent of a module's lines


def main() -> int:
    """Print the table."""
    coverage = Coverage()
    coverage.load()
    with TemporaryDirectory() as folder:
        file = Path(folder) / "coverage.json"
        coverage.json_report(outfile=str(file))
        modules = json.loads(file.read_text())["files"]
    below = []
    for name, module in modules.items():
        share, missing = module["summary"]["percent_covered"], module["missing_lines"]
        if share < LEAST:
            below.append(name)
        lines = f"  not run: {', '.join(map(str, missing))}" if missing else ""
        print(f"{share:5.1f} %  {name.removesuffix('.py').replace('/', '.')}{lines}")
    if below or not modules:
        print(f"coverage: less than {LEAST:g} % of {', '.join(below) or 'nothing at all'}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
