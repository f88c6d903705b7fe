# Two commands do everything: `make demo` flies, `make test` checks. Each sets itself up; `make help`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

# The versions that are installed, and that pip builds with: the lock, made by `make lock`.
# `make newest` takes the newest ones that pyproject.toml allows.
LOCK := constraints.txt
INSTALL = PIP_CONSTRAINT=$(LOCK) PIP_BUILD_CONSTRAINT=$(LOCK) $(BIN)/python -m pip install --quiet
EXTRAS := cluster console dev docs fetch mcap openvino pyrender ulog

# OpenVINO is faster than onnxruntime only where the processor computes in bfloat16.
BFLOAT16 := $(shell grep -qsE 'amx_bf16|avx512_bf16' /proc/cpuinfo && echo ,openvino)

CHECKED := tests/test_house.py tests/test_docs_commands.py tests/companion/test_config.py \
	tests/localizer/geometry tests/localizer/integrity tests/companion/integrity_monitor \
	tests/companion/calibration_watch tests/mavlink_bridge/injection tests/mavlink_bridge/link \
	tests/mavlink_bridge/vehicle

.PHONY: help demo check test newest setup lock clean

help:
	@echo "make demo    fly without GNSS and write report/ (ARGS=\"--seed 1\": options of sitl demo)"
	@echo "make check   lint and the fast tests of the core: two minutes"
	@echo "make test    lint, types, tests: up to twenty minutes"
	@echo "make newest  make test with the newest versions of all packages, in $(VENV)-newest"
	@echo "make lock    write the newest versions into constraints.txt and constraints-gpu.txt"
	@echo "make setup   only make the environment: then .venv/bin/companion --help"
	@echo "make clean   remove the environment and report/"

demo: $(VENV)/.demo
	$(BIN)/python -m sitl demo $(ARGS)

# The fast tests of what a change is most likely to break.
check: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m pytest --part=side-by-side --numprocesses=2 --dist=loadfile $(CHECKED) $(ARGS)

test: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m tests.parts $(ARGS)

newest:
	rm -rf $(VENV)-newest
	$(MAKE) test VENV=$(VENV)-newest LOCK=/dev/null

setup: $(VENV)/.demo
	@echo "ready: $(BIN)/companion --help"

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: $(BIN)/python pyproject.toml $(LOCK)
	@echo "installing what the program needs into $(VENV), minutes the first time"
	$(INSTALL) --editable '.[console$(BFLOAT16)]'
	touch $@

# Most of what is installed is never imported: what is, Python compiles then.
$(VENV)/.dev: $(BIN)/python pyproject.toml $(LOCK)
	@echo "installing what program, tests and training need into $(VENV), minutes the first time"
	$(INSTALL) --no-compile --editable '.[dev,train]'
	touch $@

# uv resolves for every Python and processor at once. torch asks for CUDA 13, a Jetson has CUDA 12:
# two files.
lock:
	$(PYTHON) -m venv $(VENV)-lock
	$(VENV)-lock/bin/python -m pip install --quiet --upgrade uv
	$(call locked,constraints.txt,train)
	$(call locked,constraints-gpu.txt,gpu)

locked = ( echo "\# Made by 'make lock': all extras but $(if $(filter gpu,$(2)),train,gpu)." && \
	$(VENV)-lock/bin/uv pip compile pyproject.toml --quiet --universal --python-version 3.10 --upgrade \
	$(EXTRAS:%=--extra %) --extra $(2) --no-annotate --no-header ) > $(VENV)-lock/$(1) && mv $(VENV)-lock/$(1) $(1)

clean:
	rm -rf $(VENV) $(VENV)-newest $(VENV)-lock report
