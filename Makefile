# Makes its own virtual environment in .venv; `make test PYTHON=python3.13 VENV=.venv313` takes another interpreter, and
# `make test CONSTRAINTS=tests/lowest.txt VENV=.venv-lowest` the lowest versions that setup.cfg admits.
# pybullet has ready-made wheels up to Python 3.11, so the newest of those is taken where there is one.
PYTHON ?= $(firstword $(foreach p,python3.11 python3.10 python3,$(if $(shell $(p) -c "print(1)" 2>/dev/null),$(p))))
VENV ?= .venv
CONSTRAINTS ?=

.PHONY: demo test clean

# From Python 3.12 on neither asks for pybullet, which would have to be compiled: both do without it what they can.
demo: $(VENV)/demo
	$(VENV)/bin/hind4sight demo --out runs/demo

test: $(VENV)/test
	$(VENV)/bin/python -m pytest

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/demo $(VENV)/test: setup.cfg pyproject.toml $(CONSTRAINTS) | $(VENV)/bin/python
	$(VENV)/bin/pip install --quiet --disable-pip-version-check $(addprefix -c ,$(CONSTRAINTS)) -e "$(if $(findstring test,$(notdir $@)),.[test],.)"
	touch $@

clean:
	rm -rf $(VENV) runs/demo
