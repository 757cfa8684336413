PYTHON ?= python3
BIN := .venv/bin

.PHONY: install lint type test mutation soak bench docs wheel lock

install:  ## virtual environment with everything that development needs
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -c requirements.lock -e ".[dev]"

lint:
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

type:
	$(BIN)/mypy

test:
	$(BIN)/python -m pytest

mutation:  ## which changes of the mathematics no test notices; hours
	$(BIN)/pip install -c requirements.lock -e ".[dev,mutation]"
	nice -n 19 $(BIN)/python tests/mutation.py

soak:  ## long runs: memory, descriptors and threads stay where they are; minutes on an idle machine
	$(BIN)/python tests/soak.py

bench:  ## timed figures on an idle machine, and the tables of docs/ from them
	for name in physics collector scaling learner mjx parity; do \
		$(BIN)/python -m hasrl_jax.bench $$name --json benchmarks/results/$$name.json || exit 1; done
	$(BIN)/python -m hasrl_jax.bench docs

docs:  ## the documentation site in site/; a warning or a dead link is an error
	$(BIN)/pip install -q -c requirements.lock -e ".[docs]"
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

wheel:  ## wheel and sdist in dist/, checked, installed in an empty environment elsewhere, and used
	$(BIN)/pip install -q -c requirements.lock -e ".[release]"
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/twine check --strict dist/*
	$(BIN)/python tools/try_wheel.py dist

COMPILE := uv pip compile --universal --python-version 3.11 --no-header --no-annotate pyproject.toml
EXTRAS := $(foreach name,cuda deploy dev docs menagerie mlflow mutation ray release viewer,--extra $(name))

# Left out: `compare` and `frameworks`, whose torch is the platform's, and `sweep` and `wandb`, which fit in with it.
lock:  ## after a change of dependencies in pyproject.toml
	$(BIN)/pip install uv
	$(BIN)/$(COMPILE) $(EXTRAS) -o requirements.lock
	$(BIN)/$(COMPILE) -c requirements.lock --generate-hashes --extra viewer -o docker/requirements-cpu.lock
	$(BIN)/$(COMPILE) -c requirements.lock --generate-hashes --extra viewer --extra cuda -o docker/requirements-cuda.lock
