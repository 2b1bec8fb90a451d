# Each target does all its own set-up on a fresh Debian 12+ or Ubuntu 24.04+ machine; see deploy/setup.sh.
.PHONY: demo lab-demo bom deploy-test deploy-check manifests gallery figures quick test test-all faults contracts attacks roles clients bare-test lint bench dashboard setup

BIN := .venv/bin
# Files stay whole, because their tests share what they compute; tests/conftest.py puts the dearest files first. Compiled
# test files are kept, also where the environment forbids bytecode: reading them takes half the time of making them.
PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder

demo: setup ## simulated rig -> capture -> preparation -> fit of three channels -> asset, report and a picture, below demo/
	@$(BIN)/dentine demo --out demo

lab-demo: setup ## virtual laboratory: raw frames -> calibration -> registration -> preparation -> fit -> comparison with the truth, below lab/
	@$(BIN)/dentine lab-demo --out lab

gallery: setup ## pictures of a tooth in an ordinary scene, in gallery/, some minutes
	@$(BIN)/python -m services.bench.figures.gallery --out gallery

figures: setup ## the figures of teeth 2018 from fits of this project's own, in figures/, tens of minutes
	@$(BIN)/python -m services.bench.figures --out figures

quick: setup ## what a change is tried with while it is made, a minute and a half on two cores
	@$(PYTEST) -m "not slow" tests/unit

test: ## all but the tests that take many minutes; what the machine cannot run is skipped with its reason
	@deploy/setup.sh dashboard browser
	@$(PYTEST) -m "not slow" --ignore tests/architecture

test-all: ## the slow ones too: fits of the real incisor, long slab tables
	@deploy/setup.sh dashboard browser
	@$(BIN)/python -m pytest

faults: ## kill -9 of every part of the service at every point of a job, a quarter of an hour; needs Postgres
	@deploy/setup.sh
	@$(BIN)/python -m tests.faults.kill_matrix --json faults.json

contracts: ## ten thousand requests generated from the API's description, on SQLite and on Postgres, some minutes each
	@deploy/setup.sh
	@$(BIN)/python -m tests.contracts.generated_requests --json contracts-sqlite.json
	@$(BIN)/python -m tests.contracts.generated_requests --database postgres --json contracts-postgres.json

attacks: ## every attack that is tried on the service, and their table in services/api/ATTACKS.md, some minutes
	@deploy/setup.sh
	@$(BIN)/python -m tests.contracts.attack_list --json attacks.json

roles: ## every part of the service in a virtual environment of its own, and a small job through them, some minutes; installs from the package index
	@deploy/setup.sh
	@$(BIN)/python -m pytest tests/architecture/test_role_packages.py tests/pipeline/test_roles.py tests/pipeline/test_api_install.py

clients: setup ## assets opened by programs of others, Blender among them, some minutes; installs them from the package index into .clients, see deploy/clients.txt
	@deploy/clients.sh
	@$(BIN)/python -m pytest -rs tests/clients

SUITE ?= bookworm
bare-test: ## demo and test on a machine with apt, make and python3 alone, in a folder; SUITE names it; needs root and mmdebstrap, see docs/start/install.md
	@deploy/bare_machine.sh $(SUITE)

deploy-test: setup ## build the images, run the composed system in real containers and disturb it, half an hour; needs an engine, see docs/use/deployment.md
	@tests/containers/build.sh
	@$(BIN)/python -m pytest tests/containers

deploy-check: setup ## the files of deploy/ against their formats' own validators
	@$(BIN)/python -m pytest tests/pipeline/test_deploy_files.py

bom: setup ## what each image is made of, as CycloneDX bills of material in bom/
	@deploy/bom.sh bom

manifests: setup ## write deploy/kubernetes/dentine.yaml from deploy/compose.yaml
	@$(BIN)/python deploy/kubernetes/render.py

lint: setup ## style, types, imports, names, links and licences: what can be said of the code without running it
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/lint-imports
	@$(BIN)/python -m pytest tests/architecture
	@$(BIN)/mypy

bench: setup
	@$(BIN)/dentine bench all

dashboard: ## bundle the dashboard's TypeScript into services/api/dashboard/static
	@deploy/setup.sh dashboard

setup:
	@deploy/setup.sh
	@$(if $(filter setup,$(MAKECMDGOALS)),echo 'dentine is set up: $(BIN)/dentine --help lists its commands and make demo tries it',:)
