# Two commands do everything: `make demo` and `make test`. Both set up .venv first, with the pins of constraints.txt.

VENV := .venv
BIN := $(VENV)/bin
PYTHON ?= $(shell command -v python3.11 || command -v python3)
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt
INSTALLED := $(VENV)/.installed
VIRTUALENV := .cache/virtualenv

.PHONY: demo test quick setup wheel clean

# Train the robot to stand, then play the policy for one episode and print how it stood.
demo: setup
	$(BIN)/wheelleg train task=stand agent=quick
	$(BIN)/wheelleg play latest

# Everything that continuous integration runs.
test: setup
	$(BIN)/nox --sessions lint typecheck docs repro
	$(BIN)/nox --sessions tests

# Lint, types, and the fast tests of single packages.
quick: setup
	$(BIN)/nox --sessions lint typecheck quick

# One file that installs without this checkout.
wheel:
	@rm -rf build/lib build/bdist.* dist # setuptools would add modules that no longer exist
	@$(PYTHON) -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir dist .
	@echo "built $$(ls dist/*.whl): uvx --from $$(ls dist/*.whl) wheelleg play stock:walk"

setup: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "wheelleg_exp needs Python 3.11 or later; set PYTHON=/path/to/python3.11"; exit 1; }
	@echo "setting up $(VENV) (once; 3.1 GB with torch for CPUs, 6.6 GB with CUDA: see README.md)"
	@$(PYTHON) -m venv $(VENV) 2>/dev/null && $(BIN)/python -m pip --version >/dev/null 2>&1 \
		|| { rm -rf $(VENV); $(PYTHON) -m pip install --quiet --target $(VIRTUALENV) virtualenv \
			&& PYTHONPATH=$(VIRTUALENV) $(PYTHON) -m virtualenv --quiet $(VENV); }
	@$(PIP_INSTALL) -e ".[dev]"
	@$(PIP_INSTALL) --no-deps mujoco-warp mjviser # both require the metapackage mujoco, which pins mujoco-core 4.0.0
	@$(BIN)/python -m compileall -qq -j 0 $(VENV)/lib wheelleg_exp >/dev/null 2>&1 || true # on all cores, as pip does on one
	@touch $(INSTALLED)

clean:
	rm -rf $(VENV) .nox .cache .pytest_cache .mypy_cache .ruff_cache build dist *.egg-info
