# Makes its own virtual environment in .venv; `make PYTHON=python3.10 test` chooses the interpreter.
# pybullet has ready-made wheels up to Python 3.11, so the newest of those is taken where there is one.
PYTHON ?= $(firstword $(foreach p,python3.11 python3.10 python3,$(if $(shell $(p) -c "print(1)" 2>/dev/null),$(p))))
BIN = .venv/bin

.PHONY: demo test clean

demo: .venv/demo
	$(BIN)/hind4sight demo --out runs/demo

test: .venv/test
	$(BIN)/python -m pytest

.venv/bin/python:
	$(PYTHON) -m venv .venv

.venv/test: setup.cfg pyproject.toml | .venv/bin/python
	$(BIN)/pip install --quiet --disable-pip-version-check -e ".[test]"
	touch $@

# From Python 3.12 on this leaves pybullet out, which would compile for minutes; the demo then takes the shipped pokes.
.venv/demo: setup.cfg pyproject.toml | .venv/bin/python
	$(BIN)/pip install --quiet --disable-pip-version-check -e .
	touch $@

clean:
	rm -rf .venv runs/demo
