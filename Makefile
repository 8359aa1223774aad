# Two commands on a fresh clone: `make demo` and `make test`. Each makes $(VENV) if need be.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
# What the tests and the notebooks have compiled need not be compiled again.
CACHED = JAX_COMPILATION_CACHE_DIR=$(CURDIR)/.jax_cache JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0

.PHONY: demo test thorough lint types notebooks docs benchmarks clean

demo: $(VENV)/installed
	$(BIN)/python -m ehsvjax --out out

test: $(VENV)/installed-test
	$(BIN)/python -m pytest -n auto --dist loadgroup

# With those that take minutes, as every night.
thorough: $(VENV)/installed-test
	$(BIN)/python -m pytest -n auto --dist loadgroup -m ""

lint: $(VENV)/installed-develop
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/installed-develop
	$(BIN)/mypy

notebooks: $(VENV)/installed-develop
	$(BIN)/python notebooks/run_all.py

# Pages that open from a folder, build/docs/index.html; what they are made of is put together in build/pages.
docs: $(VENV)/installed-docs
	rm -rf build/pages build/docs
	mkdir -p build
	cp -r docs build/pages
	cp notebooks/*.ipynb notebooks/*.png build/pages/notebooks
	cp CHANGELOG.md build/pages/changes.md
	$(CACHED) $(BIN)/python docs/gallery.py build/pages/gallery
	$(CACHED) $(BIN)/python -m sphinx -W --keep-going -q -d build/doctrees build/pages build/docs

# What the fits are worth, then how fast they are. Speed wants a quiet machine.
benchmarks: $(VENV)/installed-benchmark
	$(BIN)/python benchmarks/monte_carlo.py
	$(BIN)/python benchmarks/wide_bounds.py
	$(BIN)/python benchmarks/precision.py
	$(BIN)/python benchmarks/diagnosis.py
	$(BIN)/python benchmarks/several_outputs.py
	$(BIN)/python benchmarks/generations_per_second.py
	$(BIN)/python benchmarks/against_c.py
	$(BIN)/python benchmarks/equal_accuracy.py
	$(BIN)/python benchmarks/several_processes.py
	$(BIN)/python benchmarks/scaling.py
	$(BIN)/python benchmarks/cold_start.py
	$(BIN)/python benchmarks/damaged_files.py
	$(BIN)/python benchmarks/damaged_calls.py

$(VENV)/bin/python:
	$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11) and 'ehsvjax needs Python 3.11 or newer')"
	$(PYTHON) -m venv $(VENV)

$(VENV)/installed: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $@

$(VENV)/installed-test: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[test]"
	touch $@

$(VENV)/installed-develop: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[develop]"
	touch $@

$(VENV)/installed-docs: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[docs]"
	touch $@

$(VENV)/installed-benchmark: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[benchmark]"
	touch $@

clean:
	rm -rf $(VENV) out build *.egg-info
