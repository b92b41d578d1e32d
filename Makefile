# Everything a newcomer needs: `make demo` and `make test`. Each verb installs what it needs into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# Tests wait for processes a fifth of their time: three at once keep two cores busy.
JOBS ?= 3

.PHONY: results docs-commands dist gpu-check help install demo test test-slow test-containers check format browser screenshots docs docs-site pins licences audit clean
help: ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-15s %s\n", $$1, $$2}'

$(STAMP): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(0 if (3, 11) <= sys.version_info < (3, 14) else "graspd needs Python 3.11, 3.12 or 3.13: make PYTHON=python3.12 ...")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

install: $(STAMP) ## .venv with graspd and its tools

demo: $(STAMP) ## the main job on built-in data: grasps, scenes, pictures
	$(BIN)/graspd demo --out demo-out

test: $(STAMP) ## the tests (under 20 minutes on 2 cores)
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal

test-slow: $(STAMP) ## the long accuracy and soak runs
	$(BIN)/python -m pytest -m 'slow and not containers'

test-containers: $(STAMP) ## images built, compose up, a job through two kills (needs a container engine)
	$(BIN)/python -m pytest -m containers -rs tests/containers

check: $(STAMP) ## format, lint, types, import contracts, spelling
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/codespell

format: $(STAMP) ## rewrite the sources in the house style
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

browser: $(STAMP) ## Chromium and Playwright for the dashboard's tests (Debian, as root)
	command -v chromium > /dev/null || { apt-get update -qq && apt-get install -qq -y --no-install-recommends chromium; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,browser]'

screenshots: $(STAMP) ## the dashboard's pages of a real service, for docs/how-to/dashboard.md (needs make browser)
	$(BIN)/python -m benchmarks.screenshots

docs: $(STAMP) ## rewrite the tables in the docs that follow from the code
	$(BIN)/python -m graspd.service.docs
	$(BIN)/python -m benchmarks.results --pages

docs-site: $(STAMP) ## the documentation as a site in build/site, with search; warnings are errors
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

docs-commands: $(STAMP) ## the commands that README and docs print, run as printed (hours; PAGE=name.md: one page)
	$(BIN)/python -m docs.commands $(PAGE)

results: $(STAMP) ## every figure and picture of the docs again, resumable (DATA=, SOURCES=, BEFORE=; QUICK=1: 20 minutes)
	$(BIN)/python -m benchmarks.results $(if $(QUICK),--quick) $(if $(DATA),--data $(DATA)) \
		$(if $(SOURCES),--sources $(SOURCES)) $(if $(BEFORE),--before $(BEFORE))

gpu-check: $(STAMP) ## every kernel compiled for CUDA: registers, stack, spills (no GPU needed; ARCH="80 90": these alone)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,gpu-check]'
	$(BIN)/python -m benchmarks.gpu_check $(foreach arch,$(ARCH),--arch $(arch))

dist: $(STAMP) ## wheel and sdist in dist/, the same bytes from the same sources; see docs/how-to/release.md
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,release]'
	$(BIN)/python docker/dist.py dist

pins: $(STAMP) ## versions and hashes that the images install: those of .venv (asks the package index)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,postgres,gpu]'
	$(BIN)/python docker/pin.py

licences: $(STAMP) ## licences of what graspd runs with, into docs/reference/licences.md
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,arm]'
	$(BIN)/python docker/licences.py

audit: $(STAMP) ## known vulnerabilities of what .venv and the images install (asks PyPI)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,audit]'
	$(BIN)/python docker/audit.py

clean: ## what the verbs above made
	rm -rf $(VENV) build dist demo-out *.egg-info
