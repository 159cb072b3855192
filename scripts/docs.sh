#!/usr/bin/env bash
# Build the documentation as a website; warnings are errors. Usage: bash scripts/docs.sh [FOLDER, default build/docs]
set -euo pipefail
cd "$(dirname "$0")/.."
bash scripts/setup.sh
site="${1:-build/docs}"
.venv/bin/python -m sphinx --fail-on-warning --quiet docs "$site"
echo "docs: open $site/index.html"
