# Each target sets up its own environment, with nothing but python3 (3.11 or newer) and pip.
PYTHON ?= python3
BIN := .venv/bin
OUT ?= out/demo
# A file of tests stays in one process: its tests share what they compiled.
PARALLEL := -n auto --maxprocesses 4 --dist loadfile
# About a minute of what other versions of Python, JAX and the libraries may break, compiled as users compile it.
# Libraries older or newer than the others warn of each other.
SHORT := -n auto --maxprocesses 4 --dist loadfile -o filterwarnings=default \
	$(addprefix tests/test_,imports.py primitive.py operators.py shipped_capture.py solve.py files.py mold_files.py) \
	tests/test_solvers.py::test_it_finds_two_bright_voxels
# Of the oldest Python, which has the lowest versions; of the newest at hand.
LOWEST := .venv-lowest/bin/python
NEWEST := .venv-newest/bin/python

.PHONY: demo test test-all test-lowest test-newest lint
.DELETE_ON_ERROR:

demo: .venv/core
	$(BIN)/gs-jax demo --out $(OUT)

test: .venv/dev
	$(BIN)/python -m pytest $(PARALLEL)

test-all: .venv/dev
	JAX_DISABLE_MOST_OPTIMIZATIONS=0 $(BIN)/python -m pytest $(PARALLEL) -m ""

test-lowest: .venv-lowest/test
	JAX_DISABLE_MOST_OPTIMIZATIONS=0 $(LOWEST) -m pytest $(SHORT)

# What is newest changes from day to day.
test-newest:
	@python=$$(.ci/newest-python); \
	if [ -z "$$python" ]; then echo "test-newest: skipped, no Python newer than 3.11 is at hand"; exit; fi; \
	set -ex; \
	"$$python" -m venv .venv-newest; \
	$(NEWEST) -m pip install --quiet --upgrade --upgrade-strategy eager --editable '.[test]'; \
	JAX_DISABLE_MOST_OPTIMIZATIONS=0 $(NEWEST) -m pytest $(SHORT)

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

.venv-lowest/test: pyproject.toml
	$$(command -v python3.11 || echo $(PYTHON)) -m venv .venv-lowest
	sed -n '/^dependencies/,/^]/s/^ *"\(.*\)>=\(.*\)",$$/\1==\2/p' pyproject.toml > .venv-lowest/floors.txt
	$(LOWEST) -m pip install --quiet --editable '.[test]' --constraint .venv-lowest/floors.txt
	touch $@
