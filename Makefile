# Each target sets up its own environment, with nothing but python3 (3.11 or newer) and pip.
PYTHON ?= python3
BIN := .venv/bin
OUT ?= out/demo
# What one process compiled, the others read from the cache.
PARALLEL := -n auto --maxprocesses 4 --dist worksteal
# Shapes and types are checked at each call of a function: a quarter of the time of a run, so not in the quick one.
TYPED := --jaxtyping-packages=gs_jax,beartype.beartype
# About a minute of what other versions of Python, JAX and the libraries may break, compiled as users compile it.
# Libraries older or newer than the others warn of each other, and other versions of JAX compile other programs.
SHORT := $(PARALLEL) $(TYPED) -o filterwarnings=default -o compile_budget= -m "not slow" \
	$(addprefix tests/test_,imports.py linear_map.py cpu_kernels.py shipped_capture.py solve.py files.py \
	mold_files.py layers.py solvers.py::test_it_finds_two_bright_voxels_and_nothing_in_the_dark \
	apertures.py::test_a_compiled_lens_does_not_bound_itself \
	operators.py::test_transpose_is_backprojection operators.py::test_it_composes_and_solves \
	operators.py::test_scipy_solves_with_it operators.py::test_pylops_takes_it \
	operators.py::test_scico_takes_it operators.py::test_deepinv_takes_it)
# Of the oldest Python, which has the lowest versions; of the newest at hand.
LOWEST := .venv-lowest/bin/python
NEWEST := .venv-newest/bin/python

# Ray-traced captures, if they are at hand.
DATA ?= $(wildcard ../shared/data/oracle/dev)

.PHONY: demo test integration test-all test-napari test-lowest test-newest lint figures docs dist
.DELETE_ON_ERROR:

demo: .venv/core
	$(BIN)/gs-jax demo --out $(OUT)

figures: .venv/dev
	$(BIN)/python -m experiments.gallery $(DATA) --out out/figures

test: .venv/dev
	$(BIN)/python -m pytest $(PARALLEL)

# What is slow by nature: other processes, browsers, the README, tutorials, experiments, all of the matrix of features;
# and kernels of NVIDIA Warp (130 MB), on the processor.
integration: .venv/dev
	$(BIN)/python -m pip install --quiet 'warp-lang>=1.17'
	$(BIN)/python -m pytest $(PARALLEL) $(TYPED) -m "integration and not slow"

test-all: .venv/dev
	EXAMPLES=all JAX_DISABLE_MOST_OPTIMIZATIONS=0 $(BIN)/python -m pytest $(PARALLEL) $(TYPED) -m ""

# Half a gigabyte of napari and Qt, in an environment of their own.
test-napari: .venv-napari/test
	.venv-napari/bin/python -m pytest tests/test_napari.py

# What one version of numba keeps for a Python, another would replace.
test-lowest: .venv-lowest/test
	NUMBA_CACHE_DIR=$(CURDIR)/.venv-lowest/numba JAX_DISABLE_MOST_OPTIMIZATIONS=0 $(LOWEST) -m pytest $(SHORT)

# What is newest changes from day to day. `NIGHTLY` is an index of JAX's nightly wheels.
NIGHTLY ?=
test-newest:
	@python=$$(.ci/newest-python); \
	if [ -z "$$python" ]; then echo "test-newest: skipped, no Python newer than 3.11 is at hand"; exit; fi; \
	set -ex; \
	"$$python" -m venv .venv-newest; \
	$(NEWEST) -m pip install --quiet --upgrade --upgrade-strategy eager --editable '.[test]'; \
	if [ -n "$(NIGHTLY)" ]; then $(NEWEST) -m pip install --quiet --upgrade --pre jax jaxlib --extra-index-url "$(NIGHTLY)"; fi; \
	JAX_DISABLE_MOST_OPTIMIZATIONS=0 $(NEWEST) -m pytest $(SHORT)

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

# Strict: a broken link, a public name without words or example, or a tutorial that fails ends it.
docs: .venv/docs
	$(BIN)/mkdocs build --strict --quiet --config-file docs/mkdocs.yml
	@echo "out/docs/site/index.html"

# The wheel is tried where nothing else is: not the checkout, not its environment, and at first none of the extras.
dist: .venv/dist
	rm -rf dist .venv-wheel
	$(BIN)/python -m build --outdir dist
	$(PYTHON) -m venv .venv-wheel
	.venv-wheel/bin/python -m pip install --quiet dist/*.whl
	cd / && $(CURDIR)/.venv-wheel/bin/python -c "import gs_jax; [getattr(gs_jax, name) for name in gs_jax.__all__]"
	.venv-wheel/bin/python -m pip install --quiet "$$(ls dist/*.whl)[all]" pyright
	cd / && { $(CURDIR)/.venv-wheel/bin/pyright --pythonpath $(CURDIR)/.venv-wheel/bin/python --verifytypes gs_jax \
		--ignoreexternal || true; } | grep "completeness"
	cd / && $(CURDIR)/.venv-wheel/bin/gs-jax demo --out $(CURDIR)/out/wheel

.venv/core: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --editable '.[all]'
	touch $@

.venv/dev: .venv/core
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@

.venv/docs: .venv/core
	$(BIN)/python -m pip install --quiet --editable '.[docs]'
	touch $@

.venv/dist: .venv/core
	$(BIN)/python -m pip install --quiet build
	touch $@

.venv-napari/test: pyproject.toml
	$(PYTHON) -m venv .venv-napari
	.venv-napari/bin/python -m pip install --quiet --editable '.[napari,test]'
	touch $@

.venv-lowest/test: pyproject.toml
	$$(command -v python3.11 || echo $(PYTHON)) -m venv .venv-lowest
	sed -n '/^dependencies/,/^gpu/p' pyproject.toml | grep -oE '[a-z0-9-]+>=[0-9.]+' | sed 's/>=/==/' > .venv-lowest/floors.txt
	$(LOWEST) -m pip install --quiet --editable '.[test]' --constraint .venv-lowest/floors.txt
	touch $@
