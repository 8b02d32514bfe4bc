# `make demo` and `make test` are all that a fresh machine needs: python3 with venv, and make.
# Both make a virtual environment (.venv) with the exact versions of constraints.txt first, once.
#
#   make PYTHON=python3.12 VENV=/some/where/else test PYTEST_ARGS="-k grasp"

SUPPORTED   := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))
PYTHON      ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
                 $$p -c '$(SUPPORTED)' 2>/dev/null && { echo $$p; break; }; done)
VENV        ?= .venv
OUT         ?= demo
PYTEST_ARGS ?=

BIN     := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt
RUNTIME := $(VENV)/.installed-runtime
DEV     := $(VENV)/.installed-dev

# One thread a process: the matrices are small, and the tests run in several processes.
export OMP_NUM_THREADS ?= 1
# The state of a session (say, an activated environment) must not leak into the one made here.
unexport PYTHONPATH PYTHONHOME VIRTUAL_ENV

.DEFAULT_GOAL := help
.PHONY: help demo test lint types check figures format dist clean

help:  ## Say what can be made.
	@echo "factorgrasp: what can be made"
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/  make \1\t\2/p' $(firstword $(MAKEFILE_LIST)) | expand -t 14
	@echo "Variables: PYTHON ($(or $(PYTHON),no Python 3.11 to 3.13 found)), VENV ($(VENV)), OUT ($(OUT)), PYTEST_ARGS"

demo: $(RUNTIME)  ## Solve a simulated grasp recording from disk and leave a report in $(OUT)/.
	@echo "== demo: factorgrasp demo --out $(OUT)"
	$(BIN)/factorgrasp demo --out "$(OUT)"

test: $(DEV)  ## Run all tests.
	@echo "== test: pytest on two processes"
	$(BIN)/python -m pytest -n 2 $(PYTEST_ARGS)

lint: $(DEV)  ## Check style and formatting (ruff).
	@echo "== lint: ruff check, ruff format --check"
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(DEV)  ## Check types (mypy --strict).
	@echo "== types: mypy --strict -p factorgrasp"
	$(BIN)/mypy --strict -p factorgrasp

check: lint types test  ## All of the three above.

figures: $(RUNTIME)  ## Draw the figures of docs/ afresh.
	@echo "== figures: docs/make_figures.py"
	$(BIN)/python docs/make_figures.py

format: $(DEV)  ## Mend style and formatting where ruff can.
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

dist: $(DEV)  ## Build the source archive and, from it, the wheel, into dist/.
	@echo "== dist: python -m build"
	$(BIN)/python -m build

clean:  ## Remove the environment, caches and what was built.
	rm -rf .venv build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "factorgrasp needs Python 3.11, 3.12 or 3.13: make PYTHON=/path/to/python3.12"; exit 1; }
	@$(PYTHON) -c '$(SUPPORTED)' || { echo "factorgrasp needs Python 3.11, 3.12 or 3.13; $(PYTHON) is $$($(PYTHON) --version)"; exit 1; }
	@echo "== setting up: virtual environment $(VENV) with $$($(PYTHON) --version)"
	$(PYTHON) -m venv "$(VENV)"

# setuptools first, so that the package is built with the version of constraints.txt too.
$(RUNTIME): pyproject.toml constraints.txt | $(BIN)/python
	@echo "== setting up: factorgrasp and what it needs, into $(VENV) (the first time it downloads them)"
	$(INSTALL) setuptools
	$(INSTALL) --no-build-isolation --editable .
	@touch $@

$(DEV): $(RUNTIME)
	@echo "== setting up: the tools for tests, lint and types, and the optional solvers"
	$(INSTALL) --no-build-isolation --editable '.[dev]'
	@touch $@
