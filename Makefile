# From a clone to a result: `make demo`, `make test`. Everything lives in .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SOURCES := needle_ros needle_dynamics needle_controller needle_identification needle_insertion benchmarks examples test description launch docs tools setup.py

.PHONY: demo test check docs format setup compiled lock bags results bench clean

demo: setup
	$(BIN)/needle demo

test: $(VENV)/.dev compiled
	$(BIN)/python -m pytest -n auto

check: $(VENV)/.dev
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/mypy
	$(BIN)/python -m tools.language

# The site, without the network; what Sphinx warns of is an error.
docs: $(VENV)/.docs
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs docs/_build/html
	@echo 'docs/_build/html/index.html'

format: $(VENV)/.dev
	$(BIN)/ruff check --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

setup: compiled

# Machine code for this processor: a second if it is there already.
compiled: $(VENV)/.complete
	$(BIN)/needle compile

# The marker is written last: an interrupted set-up starts anew.
$(VENV)/.complete: requirements.lock setup.py package.xml
	$(PYTHON) -m venv --clear $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

# What tests and checks need besides.
$(VENV)/.dev: requirements-dev.lock $(VENV)/.complete
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-dev.lock
	touch $@

$(VENV)/.docs: requirements-docs.lock $(VENV)/.complete
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-docs.lock
	touch $@

# Pins for every supported Python at once; run after a change of dependencies in setup.py.
lock:
	uv pip compile --quiet --universal --python-version 3.10 --no-annotate --no-header \
		--extra ros setup.py requirements-build.in -o requirements.lock
	uv pip compile --quiet --universal --python-version 3.10 --no-annotate --no-header \
		--extra ros --extra dev --constraints requirements.lock \
		setup.py requirements-build.in -o requirements-dev.lock
	uv pip compile --quiet --universal --python-version 3.10 --no-annotate --no-header \
		--extra docs --constraints requirements-dev.lock setup.py -o requirements-docs.lock

# The shipped recordings, made anew through real nodes.
bags: setup
	rm -rf bags/friction_* bags/stiffness_*
	$(BIN)/needle experiment friction --rate 100 --speed 20 bags
	$(BIN)/needle experiment stiffness --rate 40 --speed 40 bags
	cd bags && sha256sum friction_*/* stiffness_*/* > SHA256SUMS

# What the shipped recordings give.
results: setup
	set -e; { printf '# Tables 1 and 2 from the shipped recordings\n\n'; \
	printf 'This page is generated. Do not edit it, but run `make results` again.\n\n'; \
	printf -- '- date: %s\n- version: %s\n' "$$(date -u '+%Y-%m-%d %H:%M UTC')" "$$($(BIN)/needle --version)"; \
	for table in table-1 table-2; do \
	printf '\n```bash\nneedle reproduce %s\n```\n\n```text\n' $$table; $(BIN)/needle reproduce $$table; printf '```\n'; \
	done; } > docs/results/tables.md

# The figures of docs/benchmarks.md, on a machine that does nothing else. A missed bar does not end it.
bench: $(VENV)/.bench
	status=0; for name in control laws dynamics steering-model steering-fit steering safety identification 'graph --full' slicer study pool calibration; do \
	$(BIN)/needle bench $$name -o docs/results/$${name%% *}.md || status=1; \
	done; exit $$status

$(VENV)/.bench: setup.py $(VENV)/.complete
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation -e '.[bench]'
	touch $@

clean:
	rm -rf $(VENV) build install log demo_output docs/_build docs/api docs/repository
