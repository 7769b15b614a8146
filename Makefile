# Isodyn. `make help` explains every target.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Small matrices are slower on many BLAS threads than on one; processes give the parallelism.
TEST_PROCESSES ?= 2
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1

.DEFAULT_GOAL := help
.PHONY: help install install-dev demo serve test test-slow campaign fuzz lint audit format benchmarks evaluate evaluate-tracks gallery openapi lock sbom clean

help: ## Explain every target
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-12s %s\n", $$1, $$2}'

install: $(VENV)/.installed ## Create .venv and install the locked dependencies
install-dev: $(VENV)/.installed-dev ## The same, with what the tests need

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Isodyn needs Python 3.11 or newer; try: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: $(BIN)/python requirements.lock pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed requirements-dev.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-dev.lock
	@touch $@

demo: install ## Make a building, walk it, map it, locate in it; leaves the server up (ARGS="--once" exits)
	$(BIN)/isodyn demo $(ARGS)

serve: install ## Run the API, the page and an embedded worker on port 8300
	$(BIN)/isodyn serve $(ARGS)

test: install-dev ## Install, and run all tests but the slow ones
	$(BIN)/python -m pytest -m "not slow" -n $(TEST_PROCESSES) --dist loadfile --no-loadscope-reorder $(ARGS)

test-slow: install-dev ## Run the slow tests
	$(BIN)/python -m pytest -m slow $(ARGS)

campaign: install-dev ## Kill and cut everything during 300 uploads, on both back ends (ARGS="--uploads 30")
	$(BIN)/python -m tests.reliability.campaign $(ARGS)

fuzz: install-dev ## 50,000 requests from the contract, 10,000 odd surveys and windows (ARGS="--contract 1000")
	$(BIN)/python -m tests.reliability.fuzz $(ARGS)

lint: install-dev ## Style, types and import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

audit: ## Look for known vulnerabilities of the locked dependencies
	.ci/audit

format: install-dev ## Format the code
	$(BIN)/ruff check --fix --select I .
	$(BIN)/ruff format .

benchmarks: install-dev ## Measure every performance claim; each prints both sides and a ratio
	@for script in benchmarks/*.py; do echo "== $$script"; $(BIN)/python $$script || exit 1; done

evaluate: install ## Evaluate on real walks: make evaluate DIR=path/to/site
	$(BIN)/isodyn evaluate $(DIR)

evaluate-tracks: install ## Follow real walks: make evaluate-tracks DIR=path/to/site
	$(BIN)/isodyn evaluate tracks $(DIR)

gallery: install-dev ## Make the documentation's pictures of the page anew, by its browser tests
	ISODYN_GALLERY=1 $(BIN)/python -m pytest tests/browser

openapi: install ## Write the OpenAPI document to docs/openapi.json
	$(BIN)/isodyn openapi --output docs/openapi.json

lock: install-dev ## Resolve the dependencies anew
	$(BIN)/python -m pip install --quiet pip-tools
	$(BIN)/pip-compile --quiet --upgrade --strip-extras --no-emit-index-url --no-emit-find-links --no-emit-trusted-host --no-annotate --no-header -o requirements.lock pyproject.toml
	$(BIN)/pip-compile --quiet --upgrade --extra dev --strip-extras --no-emit-index-url --no-emit-find-links --no-emit-trusted-host --no-annotate --no-header -o requirements-dev.lock pyproject.toml
	$(BIN)/pip-compile --quiet --upgrade --extra otel --strip-extras --no-emit-index-url --no-emit-find-links --no-emit-trusted-host --no-annotate --no-header -o requirements-otel.lock pyproject.toml

sbom: install-dev ## Write what is shipped, as CycloneDX, to build/isodyn.cdx.json
	@mkdir -p build
	$(BIN)/cyclonedx-py requirements requirements-otel.lock --pyproject pyproject.toml --output-reproducible --output-file build/isodyn.cdx.json

clean: ## Remove the environment and caches (never your data in var/)
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
