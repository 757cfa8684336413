PYTHON ?= python3
BIN := .venv/bin

.PHONY: install lint type test bench lock

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

bench:  ## timed figures on an idle machine, and the tables of docs/ from them
	for name in collector scaling learner mjx parity; do \
		$(BIN)/python -m hasrl_jax.bench $$name --json benchmarks/results/$$name.json || exit 1; done
	$(BIN)/python -m hasrl_jax.bench docs

lock:  ## after a change of dependencies in pyproject.toml; the extra `compare` is left to the platform's torch
	$(BIN)/pip install uv
	$(BIN)/uv pip compile --universal --python-version 3.11 --extra dev --extra mutation --extra ray --extra viewer --no-header --no-annotate pyproject.toml -o requirements.lock
