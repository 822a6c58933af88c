# SPDX-License-Identifier: Apache-2.0
# First run of a clone: `make demo`, `make test`. All dependencies are installed in .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SOURCES := needle_ros needle_dynamics needle_controller needle_identification needle_study needle_planning needle_insertion reproduction benchmarks examples test description launch docs tools setup.py

.PHONY: demo test check docs format setup compiled wheel lock bags results bench clean

demo: setup
	$(BIN)/needle demo

# The threads of BLAS would wait for each other: the workers use all cores.
test: $(VENV)/.dev compiled
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto

check: $(VENV)/.dev
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/python -m tools.quiet_command $(BIN)/mypy
	$(BIN)/python -m tools.quiet_command $(BIN)/python -m tools.language
	$(BIN)/python -m tools.safety_file
	$(BIN)/python -m tools.changelog --check
	$(BIN)/python -m tools.license
	$(BIN)/python -m tools.commit_message

# Documentation site, without network access; Sphinx warnings are errors.
docs: $(VENV)/.docs compiled
	$(BIN)/python -m sphinx -q -W -E --keep-going -b html docs docs/_build/html
	@echo 'docs/_build/html/index.html'

format: $(VENV)/.dev
	$(BIN)/ruff check --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

setup: compiled

# Machine code for this processor; 1 s if it exists.
compiled: $(VENV)/.complete
	$(BIN)/needle compile

# Wheel for the Python version of .venv, with machine code for x86-64-v3: its first start compiles nothing.
wheel: setup
	$(BIN)/needle compile --portable
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --no-build-isolation -w dist .

# The marker is written last: an interrupted setup restarts. Older versions of pip install without a word.
$(VENV)/.complete: requirements.lock setup.py package.xml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10) and "error: $(PYTHON) is Python " \
		+ sys.version.split()[0] + ", 3.10 or newer is needed: make setup PYTHON=...")'
	@echo 'installing 760 MB into $(VENV), a minute or two'
	@test ! -L $(VENV) || rm $(VENV)  # A link leads to another environment, which venv would empty.
	$(PYTHON) -m venv --clear --without-pip $(VENV)
	$(BIN)/python -m ensurepip --default-pip
	$(BIN)/python -m pip install --disable-pip-version-check 'pip>=25.1'
	$(BIN)/python -m pip install --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

# Additional dependencies of tests and checks.
$(VENV)/.dev: requirements-dev.lock $(VENV)/.complete
	$(BIN)/python -m pip install --disable-pip-version-check -r requirements-dev.lock
	touch $@

$(VENV)/.docs: requirements-docs.lock $(VENV)/.complete
	$(BIN)/python -m pip install --disable-pip-version-check -r requirements-docs.lock
	touch $@

# Pins for all supported Python versions; run after a change of dependencies in setup.py.
lock:
	uv pip compile --quiet --universal --python-version 3.10 --no-annotate --no-header \
		--extra ros --extra plan setup.py requirements-build.in -o requirements.lock
	uv pip compile --quiet --universal --python-version 3.10 --no-annotate --no-header \
		--extra ros --extra plan --extra dev --constraints requirements.lock \
		setup.py requirements-build.in -o requirements-dev.lock
	uv pip compile --quiet --universal --python-version 3.10 --no-annotate --no-header \
		--extra docs --constraints requirements-dev.lock setup.py -o requirements-docs.lock

# Regenerate the shipped recordings with the nodes.
bags: setup
	rm -rf bags/friction_* bags/stiffness_*
	$(BIN)/needle experiment friction --rate 100 --speed 20 bags
	$(BIN)/needle experiment stiffness --rate 40 --speed 40 bags
	cd bags && sha256sum friction_*/* stiffness_*/* > SHA256SUMS

# Results of the shipped recordings.
results: setup
	set -e; { printf '# Tables 1 and 2 from the shipped recordings\n\n'; \
	printf 'This page is generated. Do not edit it, but run `make results` again.\n\n'; \
	printf -- '- date: %s\n- version: %s\n' "$$(date -u '+%Y-%m-%d %H:%M UTC')" "$$($(BIN)/needle --version)"; \
	for table in table-1 table-2; do \
	printf '\n```bash\nneedle reproduce %s\n```\n\n```text\n' $$table; $(BIN)/needle reproduce $$table; printf '```\n'; \
	done; } > docs/results/tables.md

# Numbers of docs/benchmarks.md, on an otherwise idle machine. A missed bar does not stop the run.
bench: $(VENV)/.bench
	$(BIN)/python -m benchmarks.run docs/results

$(VENV)/.bench: setup.py $(VENV)/.complete
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation -e '.[bench]'
	touch $@

clean:
	rm -rf $(VENV) build install log demo_output docs/_build docs/api docs/gallery docs/repository
