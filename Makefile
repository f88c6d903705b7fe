# Two commands do everything: `make demo` flies, `make test` checks. Each sets itself up; `make help`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: help demo test setup clean

help:
	@echo "make demo    fly without GNSS and write report/ (ARGS=\"--seed 1\": options of sitl demo)"
	@echo "make test    lint, types, tests: up to twenty minutes"
	@echo "make setup   only make the environment: then .venv/bin/companion --help"
	@echo "make clean   remove the environment and report/"

demo: $(VENV)/.demo
	$(BIN)/python -m sitl demo $(ARGS)

test: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m tests.parts $(ARGS)

setup: $(VENV)/.demo
	@echo "ready: $(BIN)/companion --help"

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: $(BIN)/python pyproject.toml
	@echo "installing what the program needs into $(VENV), minutes the first time"
	$(BIN)/python -m pip install --quiet --editable '.[console]'
	touch $@

# Most of what is installed is never imported: what is, Python compiles then.
$(VENV)/.dev: $(BIN)/python pyproject.toml
	@echo "installing what program, tests and training need into $(VENV), minutes the first time"
	$(BIN)/python -m pip install --quiet --no-compile --editable '.[dev,train]'
	touch $@ $(VENV)/.demo

clean:
	rm -rf $(VENV) report
