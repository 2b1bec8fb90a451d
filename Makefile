# Each target does all its own set-up on a fresh Debian 12+ or Ubuntu 24.04+ machine; see deploy/setup.sh.
.PHONY: demo test test-quick lint bench dashboard setup

BIN := .venv/bin

demo: setup ## simulated rig -> capture -> preparation -> fit -> asset and report, below demo/
	@test -e demo/mouth/capture.json || $(BIN)/dentine phantom --out demo/mouth --pixel-mm 0.5 --cameras 3 --lights 8 --samples 2048
	@$(BIN)/dentine run deploy/examples/demo.toml --out demo

test: ## everything; what the machine cannot run is skipped with its reason
	@deploy/setup.sh dashboard browser
	@$(BIN)/python -m pytest

test-quick: setup ## without the tests that take minutes
	@$(BIN)/python -m pytest -m "not slow and not browser"

lint: setup
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

bench: setup
	@$(BIN)/dentine bench all

dashboard: ## bundle the dashboard's TypeScript into services/api/dashboard/static
	@deploy/setup.sh dashboard

setup:
	@deploy/setup.sh
