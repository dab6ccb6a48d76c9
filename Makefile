# Each target sets up its own environment in .venv, with nothing but python3 (3.11 or newer) and pip.
PYTHON ?= python3
BIN := .venv/bin
OUT ?= out/demo

.PHONY: demo test test-all lint
.DELETE_ON_ERROR:

demo: .venv/core
	$(BIN)/gs-jax demo --out $(OUT)

test: .venv/dev
	$(BIN)/python -m pytest

test-all: .venv/dev
	$(BIN)/python -m pytest -m ""

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
