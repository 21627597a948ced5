# `make study` runs the scaling study, `make play` serves a page on which a trained model is driven, `make test`
# runs the tests. All first create .venv and install into it, which is all that `make install` does. PYTHON=python3.12
# chooses the interpreter.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= runs/study
PRESET ?= cpu
PORT ?= 8765
EXTRA ?=
COMMA := ,
GIVEN := $(subst $(COMMA), ,$(EXTRA))
ifneq ($(EXTRA),)
EXTRAS := $(shell sed -n '/^.project.optional/,/^\[/s/^\([a-z0-9-]*\) = .*/\1/p' pyproject.toml)
ifneq ($(word 2,$(EXTRA))$(filter-out $(EXTRAS),$(GIVEN)),)
$(error EXTRA is '$(EXTRA)': give any of $(EXTRAS), separated by commas without spaces, or leave it out)
endif
endif

# Trials at a time: two on a processor, and one on GPUs or TPU chips, which it has for itself.
OF_PROCESSORS := smoke smoke-continuous cpu cpu-full cpu-continuous cpu-full-continuous play
WORKERS ?= $(if $(filter cuda cuda12 tpu,$(GIVEN))$(filter-out $(OF_PROCESSORS),$(PRESET)),1,2)

# What is imported is compiled once and kept in .venv: hundreds of processes of the tests would each compile it again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help install study play test test-slow clean

help:
	@echo "make install    only install (EXTRA=cuda,convert: extras of pyproject.toml, separated by commas)"
	@echo "make study      run the scaling study (PRESET=$(PRESET), OUT=$(OUT), WORKERS=$(WORKERS); EXTRA=cuda, cuda12 or tpu)"
	@echo "make play       drive a trained model in the browser (RUN=a training run, PORT=$(PORT))"
	@echo "make test       run the tests that take less than about 20 s each"
	@echo "make test-slow  run the others too"
	@echo "make clean      remove the environment and caches; results under runs/ stay"

# EXTRA is what is installed besides: for other devices than the processor cuda (CUDA 13), cuda12 (for older drivers) or tpu.
install: $(VENV)/installed$(addprefix -,$(EXTRA))
	@echo "to use it in this shell: . $(BIN)/activate"

study: $(VENV)/installed$(addprefix -,$(EXTRA))
	$(BIN)/hma study --preset $(PRESET) --out $(OUT) --workers $(WORKERS)

# Of the committed model tokens are drawn: more objects were found so (docs/endurance.md).
play: $(VENV)/installed-play
	JAX_COMPILATION_CACHE_DIR=$(CURDIR)/.jax_cache $(BIN)/hma play $(if $(RUN),$(RUN),--temperature 0.7) --port $(PORT)

# One process per core, each with its own JAX; compiled programs are shared through .jax_cache.
PYTEST = JAX_COMPILATION_CACHE_DIR=$(CURDIR)/.jax_cache $(BIN)/python -m pytest -q
PER_CORE = -n auto --maxprocesses 8 --dist worksteal

# Tests in a process beside the others take what time these leave (they wait for files and browsers now and then), and what
# they found is said after them: promises of equal numbers, which are tested as users compile, without the flags of
# tests/conftest.py; then some long ones.
files_with = $(shell grep -rl --include='test_*.py' 'mark.$(1)' tests)
BESIDE_LOG = $(VENV)/beside.log

test: $(VENV)/installed-test
	@echo "beside these tests, those of equal numbers and some long ones run in a process of their own"; \
	(XLA_FLAGS= nice -n 19 env $(PYTEST) -m "exact and not slow" $(call files_with,exact) && equal=0 || equal=$$?; \
	nice -n 19 env $(PYTEST) -m "beside and not slow" $(call files_with,beside) && exit $$equal) \
	    >$(BESIDE_LOG) 2>&1 & beside=$$!; \
	$(PYTEST) $(PER_CORE) -m "not (exact or beside or slow)" && others=0 || others=$$?; \
	wait $$beside && found=0 || found=$$?; \
	echo "tests of equal numbers, and long ones:"; cat $(BESIDE_LOG); \
	exit $$((others > found ? others : found))

test-slow: $(VENV)/installed-test
	XLA_FLAGS= $(PYTEST) $(PER_CORE) -m exact $(call files_with,exact)
	$(PYTEST) $(PER_CORE) -m "not exact"

# constraints.txt pins what was tested on Python 3.11; other versions take what pip resolves. uv installs in a quarter of the
# time, and knows nothing of pip's own configuration: where uv finds no packages, pip looks for them, and says so. Modules are
# compiled when they are imported: most never are, and compiling all of them is 40 % of pip's time.
# The extra `sim` needs an earlier NumPy than the pinned one.
PINNED = $(if $(filter sim,$(GIVEN)),$(VENV)/constraints.txt,constraints.txt)
PINS = $$($(BIN)/python -c 'import sys; print("-c $(PINNED)" if sys.version_info[:2] == (3, 11) else "")')
PIP = $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check $(PINS)
INSTALL = install() { \
	echo "installing into $(VENV) (a quarter of a minute, longer on a slow line)"; \
	grep -v ^numpy== constraints.txt >$(VENV)/constraints.txt; \
	$(PIP) uv && $(BIN)/uv pip install --quiet --python $(BIN)/python $(PINS) -e "$$1" || \
		{ echo "uv could not install: pip does, which takes longer"; $(PIP) -e "$$1"; }; \
	}; install

$(VENV)/installed: pyproject.toml constraints.txt | $(BIN)/python
	@$(INSTALL) .
	@touch $@

# With an extra of pyproject.toml.
$(VENV)/installed-%: pyproject.toml constraints.txt | $(BIN)/python
	@$(INSTALL) '.[$*]'
	@touch $@ $(VENV)/installed

$(BIN)/python:
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) not found: install Python 3.11 or newer"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "$$($(PYTHON) --version) is too old: Python 3.11 or newer is needed (make PYTHON=python3.12 ...)"; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || \
		{ echo "$(PYTHON) cannot make environments: install it (on Debian: apt install python3-venv)"; exit 1; }
	@rm -rf $(VENV)
	@$(PYTHON) -m venv $(VENV)

clean:
	rm -rf $(VENV) .jax_cache .pytest_cache *.egg-info
