PYTHON ?= python3
VENV ?= .venv-dev
EXTRAS ?= dev
BIN := $(VENV)/bin
# Tests take one thread each. Those of a file stay together: they share a browser, an environment, networks, fits.
WORKERS ?= 2
PYTEST := $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile

.PHONY: page wheel demo report test test-all gpu notebooks docs lint clean

# The stamp is newer than what it was made from, or the environment is made again. Modules are compiled when they are first
# imported: most of them never are.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "kcgs needs Python 3.11 or later: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --no-compile --quiet --disable-pip-version-check -c constraints.txt -e '.[$(EXTRAS)]'
	touch $@

# The script of the pages that `kcgs view` and `kcgs export` write, anew from export/web; it is committed.
page:
	npm --prefix export/web ci && npm --prefix export/web run build:page

wheel: $(VENV)/.installed
	$(BIN)/python -m build --no-isolation

demo: $(VENV)/.installed
	$(BIN)/kcgs demo

# What regions gain on four photos of scikit-image, in some ten minutes. More photos need data and hours: docs/results.md.
report: $(VENV)/.installed
	$(BIN)/python -m benchmarks quality -o report

test: $(VENV)/.installed
	$(PYTEST) -m "not slow"

test-all: $(VENV)/.installed
	$(PYTEST)

# On a machine with a GPU, in an environment of your own that has torch for it, since this project's has a CPU's: the tests
# that need a GPU, a profile of the first fit of a process, and the reports that have a part of it. DATA is the folder of
# images, as in docs/results.md.
GPU_REPORTS := gpu gpu-fit batch render many
gpu:
	mkdir -p gpu-reports
	$(if $(DATA),for run in cold warm; do $(PYTHON) -m cProfile -s cumtime -m kcgs fit $(DATA)/kodak/kodim05.png --overwrite \
	  --device cuda --regions none -o gpu-reports/scene.safetensors > gpu-reports/first-fit-$$run.txt || exit 1; done)
	$(PYTHON) -m pytest -q --device all tests/test_triton.py tests/kernels tests/optim tests/functional tests/fitting/test_on_device.py \
	  tests/fitting/test_pursuit.py tests/maps/test_tiles.py
	for name in $(GPU_REPORTS); do $(PYTHON) -m benchmarks $$name -o gpu-reports/$$name $(if $(DATA),--data $(DATA)) || exit 1; done

notebooks: $(VENV)/.installed
	$(BIN)/python notebooks/execute.py

# The site, in docs/_build/html. Whatever Sphinx has to say against a page or a docstring is an error.
docs: $(VENV)/.installed
	$(BIN)/python -m sphinx -W --keep-going -q -d docs/_build/doctrees docs docs/_build/html
	@echo docs/_build/html/index.html

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf demo report gpu-reports dist build docs/_build docs/generated docs/notebooks docs/benchmarks .pytest_cache .mypy_cache .ruff_cache .hypothesis
