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

bench:  ## timed figures, JSON beside the tables
	$(BIN)/python -m hasrl_jax.bench collector --json bench_collector.json
	$(BIN)/python -m hasrl_jax.bench scaling --json bench_scaling.json
	$(BIN)/python -m hasrl_jax.bench learner --json bench_learner.json
	$(BIN)/python -m hasrl_jax.bench mjx --json bench_mjx.json
	$(BIN)/python -m hasrl_jax.bench parity --json bench_parity.json

lock:  ## after a change of dependencies in pyproject.toml; the extra `compare` is left to the platform's torch
	$(BIN)/pip install uv
	$(BIN)/uv pip compile --universal --python-version 3.11 --extra dev --extra ray --extra viewer --no-header --no-annotate pyproject.toml -o requirements.lock
