# Everything a fresh clone needs: Python >= 3.11, a C++20 compiler, make. No root; all packages go into .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO_OUT ?= demo-out

SOURCES := pyproject.toml CMakeLists.txt $(shell find src -name '*.py' -o -name '*.[ch]pp')
CXX_FILES = $(shell find src -name '*.[ch]pp')

.DELETE_ON_ERROR:
.PHONY: help install test test-slow demo lint format tables clean

help:
	@echo "make test       fast tests (also what CI runs)"
	@echo "make test-slow  long statistical tests"
	@echo "make demo       five simulated measurements, registered and reported in $(DEMO_OUT)/"
	@echo "make lint       ruff, mypy, clang-format, codespell"
	@echo "make format     apply ruff and clang-format"
	@echo "make tables     fill the tables in the documents from benchmarks/results"
	@echo "make clean      remove .venv and build"

# Versions stand in pyproject.toml alone; building without isolation keeps the build incremental.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
listed = $(BIN)/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))$(1))'

$(VENV)/.build-tools: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("Python >= 3.11 is needed: make PYTHON=...")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) cmake ninja $$($(call listed,["build-system"]["requires"]))
	@touch $@

$(VENV)/.installed: $(VENV)/.build-tools $(SOURCES)
	$(PIP) --no-build-isolation --editable '.[test]'
	@touch $@

$(VENV)/.dev-tools: $(VENV)/.build-tools
	$(PIP) $$($(call listed,["project"]["optional-dependencies"]["dev"]))
	@touch $@

install: $(VENV)/.installed

# A file's tests share what they have rendered: one process each; every one takes threads of its own, too.
test: $(VENV)/.installed
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile

test-slow: $(VENV)/.installed
	$(BIN)/python -m pytest -m slow

demo: $(VENV)/.installed
	$(BIN)/planish demo --out $(DEMO_OUT)

lint: $(VENV)/.installed $(VENV)/.dev-tools
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/clang-format --dry-run -Werror $(CXX_FILES)
	$(BIN)/codespell

format: $(VENV)/.dev-tools
	$(BIN)/ruff check --fix
	$(BIN)/ruff format
	$(BIN)/clang-format -i $(CXX_FILES)

tables: $(VENV)/.installed
	$(BIN)/python benchmarks/render_tables.py

clean:
	rm -rf $(VENV) build
