.DEFAULT_GOAL := help
.PHONY: help setup check coverage format docs quickstart

help: ## list the targets
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/\1\t\2/' | expand -t 14

setup: ## make .venv with everything in it
	@bash scripts/setup.sh

check: ## everything a change is judged by: format, lint, types, tests
	@bash scripts/test.sh

coverage: ## how much of the mathematics the tests run
	@bash scripts/test.sh --cov

format: setup ## put the sources in order
	@.venv/bin/ruff format . && .venv/bin/ruff check --fix .

docs: ## build the documentation into build/docs, strictly
	@bash scripts/docs.sh

quickstart: ## render the embedded objects, train, evaluate
	@bash scripts/quickstart.sh
