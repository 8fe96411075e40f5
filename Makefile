# Everything starts here, and nothing has to be installed before: `make demo` or `make test`.
# The first run makes .venv (see docs/start/setup.md); later runs start at once.

VENV := .venv
PYTHON := $(VENV)/bin/python
SOURCES := xop_lerobot robots teleoperators benchmarks scripts tests typings
# A worker for each core, up to four; a file's tests stay together, and share what they set up.
PARALLEL := --numprocesses logical --maxprocesses 4 --dist loadfile

# Render without a display. One BLAS thread each: the planner brings its own threads.
export MUJOCO_GL ?= egl
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
export PIP_DISABLE_PIP_VERSION_CHECK = 1

.DEFAULT_GOAL := help
.PHONY: help setup demo test fast format lint type check lock clean

help:  ## Show the verbs
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-8s %s\n", $$1, $$2 }' Makefile

setup:  ## Make .venv and install the project (the other verbs do it by themselves)
	@sh scripts/setup.sh

demo: setup  ## Record and show one episode of each robot, in outputs/demo
	@$(PYTHON) scripts/demo.py

test: setup  ## Lint, then run the tests on all cores; what they skipped and why stands at the end
	@$(PYTHON) scripts/setup.py --test-tools
	@$(PYTHON) -m ruff check --quiet $(SOURCES)
	@$(PYTHON) -m pytest -q $(PARALLEL)

fast: setup  ## Lint, then run the tests but for the slow ones
	@$(PYTHON) scripts/setup.py --test-tools
	@$(PYTHON) -m ruff check --quiet $(SOURCES)
	@$(PYTHON) -m pytest -q $(PARALLEL) -m "not slow"

format: setup  ## Format the code and apply the linter's safe fixes
	@$(PYTHON) -m ruff format $(SOURCES)
	@$(PYTHON) -m ruff check --fix $(SOURCES)

lint: setup  ## Check lint, format and import rules, change nothing
	@$(PYTHON) -m ruff check $(SOURCES)
	@$(PYTHON) -m ruff format --check $(SOURCES)
	@$(VENV)/bin/lint-imports

type: setup  ## Check the types
	@$(PYTHON) -m pyright

check: lint type test  ## Everything that a change must pass

lock: | $(VENV)/bin/uv  ## Lock what pyproject.toml asks for; LOCK=--upgrade takes newer versions
	@$(VENV)/bin/uv pip compile --quiet --universal --python-version 3.12 --extra dev --generate-hashes \
		--no-annotate --custom-compile-command "make lock" --output-file requirements.lock $(LOCK) pyproject.toml

$(VENV)/bin/uv:
	@sh scripts/setup.sh

clean:  ## Remove .venv, caches and builds; recordings in outputs/ stay
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
	find $(SOURCES) -name __pycache__ -type d -prune -exec rm -rf {} +
