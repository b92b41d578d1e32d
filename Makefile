# `make demo` and `make test` are a good start. Each target installs its dependencies into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# Tests spend a fifth of their time waiting for processes: three at once keep two cores busy.
JOBS ?= 3

.PHONY: results docs-commands dist gpu-check help install demo test test-slow test-containers check format browser screenshots docs docs-site pins licences audit clean
help: ## print this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-15s %s\n", $$1, $$2}'

$(STAMP): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(0 if (3, 11) <= sys.version_info < (3, 14) else "graspd needs Python 3.11, 3.12 or 3.13: make PYTHON=python3.12 ...")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

install: $(STAMP) ## create .venv with graspd and its tools

demo: $(STAMP) ## make grasps, scenes and pictures of built-in data in demo-out/
	$(BIN)/graspd demo --out demo-out

test: $(STAMP) ## run the tests (under 20 minutes on 2 cores)
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal

test-slow: $(STAMP) ## run the long accuracy and soak tests
	$(BIN)/python -m pytest -m 'slow and not containers'

test-containers: $(STAMP) ## build images, run Compose, kill two workers during a job (needs a container engine)
	$(BIN)/python -m pytest -m containers -rs tests/containers

check: $(STAMP) ## check format, lint, types, import contracts and spelling
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/codespell

format: $(STAMP) ## format the sources and apply lint fixes
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

browser: $(STAMP) ## install Chromium and Playwright for the dashboard's tests (Debian, as root)
	command -v chromium > /dev/null || { apt-get update -qq && apt-get install -qq -y --no-install-recommends chromium; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,browser]'

screenshots: $(STAMP) ## take screenshots of the dashboard for docs/how-to/dashboard.md (needs make browser)
	$(BIN)/python -m benchmarks.screenshots

docs: $(STAMP) ## rewrite the generated tables of the docs
	$(BIN)/python -m docs.tables
	$(BIN)/python -m benchmarks.results --pages

docs-site: $(STAMP) ## build the documentation site in build/site; warnings are errors
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

docs-commands: $(STAMP) ## run the commands of README and docs (hours; PAGE=name.md: one page)
	$(BIN)/python -m docs.commands $(PAGE)

results: $(STAMP) ## recompute all figures and pictures of the docs, resumable (DATA=, SOURCES=, BEFORE=; QUICK=1: 20 minutes)
	$(BIN)/python -m benchmarks.results $(if $(QUICK),--quick) $(if $(DATA),--data $(DATA)) \
		$(if $(SOURCES),--sources $(SOURCES)) $(if $(BEFORE),--before $(BEFORE))

gpu-check: $(STAMP) ## compile all kernels for CUDA, print registers, stack, spills (no GPU needed; ARCH="80 90": only these)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,gpu-check]'
	$(BIN)/python -m benchmarks.gpu_check $(foreach arch,$(ARCH),--arch $(arch))

dist: $(STAMP) ## build reproducible wheel and sdist in dist/; see docs/how-to/release.md
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,release]'
	$(BIN)/python docker/dist.py dist

pins: $(STAMP) ## pin the images to the versions in .venv, with hashes (queries the package index)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,postgres,gpu]'
	$(BIN)/python docker/pin.py

licences: $(STAMP) ## write the licences of dependencies to docs/reference/licences.md
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,arm]'
	$(BIN)/python docker/licences.py

audit: $(STAMP) ## list known vulnerabilities of packages in .venv and images (queries PyPI)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,audit]'
	$(BIN)/python docker/audit.py

clean: ## remove .venv and built files
	rm -rf $(VENV) build dist demo-out *.egg-info
