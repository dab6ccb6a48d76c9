# Each target sets up its own environment in .venv, with nothing but python3 (3.11 or newer) and pip.
PYTHON ?= python3
BIN := .venv/bin
OUT ?= out/demo
# A file of tests stays in one process: its tests share what they compiled.
PARALLEL := -n auto --maxprocesses 4 --dist loadfile

.PHONY: demo test test-all lint
.DELETE_ON_ERROR:

demo: .venv/core
	$(BIN)/gs-jax demo --out $(OUT)

test: .venv/dev
	$(BIN)/python -m pytest $(PARALLEL)

test-all: .venv/dev
	$(BIN)/python -m pytest $(PARALLEL) -m ""

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

.venv/core: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

.venv/dev: .venv/core
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@
