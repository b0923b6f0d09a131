# Everything a fresh machine needs is done here: `make run` and `make test` set up what is missing.

VENV   := .venv
PYTEST := $(VENV)/bin/python -m pytest

INSTALLED := $(VENV)/.installed
SYSTEM    := $(VENV)/.system-libraries
VIEWER    := api/static/index.html
SITE      := site
SITE_TOOLS := $(VENV)/.site-tools

MODULES        := viewer/node_modules/.package-lock.json
MAP_CLIENTS    := tests/browser/clients/node_modules/.package-lock.json
VIEWER_SOURCES := $(wildcard viewer/*.html viewer/*.ts viewer/tsconfig.json viewer/src/* viewer/src/*/*)
# Node comes from the wheel in the virtual environment, also where another one is installed: the same build everywhere.
NPM := PATH="$(CURDIR)/$(VENV)/bin:$$PATH" npm --loglevel=error --no-audit --no-fund --no-update-notifier

export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help setup run test test-long test-thorough test-browser test-clients test-soak test-lowest test-newest lock hunt check docs docs-version notebook wheel release viewer viewer-if-possible chromium qgis nginx clean
.DELETE_ON_ERROR:

help:
	@echo "make run           set up what is missing, then serve the bundled levels and the viewer (ARGS='--port 8001')"
	@echo "make test          the tests that take seconds (ARGS='tests/terrain -x')"
	@echo "make test-long     the tests that take minutes"
	@echo "make test-thorough all hard cases at length by all algorithms, goldens on another rasteriser; over an hour"
	@echo "make test-browser  the viewer and map clients in Chromium, which is installed where it is missing"
	@echo "make test-clients  QGIS, GDAL's tools and nginx before a service; they are installed where they are missing"
	@echo "make test-soak     a service under load and faults, with figures (SOAK_SECONDS=60)"
	@echo "make test-lowest   a quick part of the tests with the lowest versions that pyproject.toml allows (Python 3.11)"
	@echo "make test-newest   the same part with the newest versions and the newest Python that is found (or PYTHON=...)"
	@echo "make lock          write requirements.lock: the newest versions that pyproject.toml allows"
	@echo "make hunt          draw new situations for an algorithm (ARGS='shadow_map --examples 1000 --seed 7')"
	@echo "make check         ruff, mypy, import-linter, the names that must not come back, and the site's links"
	@echo "make docs          build the documentation site into site/"
	@echo "make docs-version  commit the site as this version's to the local branch gh-pages, beside earlier versions"
	@echo "make notebook      run examples/a_winters_day.py into docs/a-winters-day.ipynb; look at it"
	@echo "make viewer        build the viewer into api/static/"
	@echo "make wheel         build a wheel with the viewer and compiled loops into dist/"
	@echo "make release       build and check what a package index gets, install it and draw a picture with it"
	@echo "make clean         remove everything that make has made"

setup: $(INSTALLED) $(SYSTEM)

run: setup viewer-if-possible
	$(VENV)/bin/skugga serve $(ARGS)

# Two processes (OpenGL has one thread in each), whole files to each: fixtures of a file are made once.
# On a build server a viewer that does not build is a failure; elsewhere the tests run without it.
test: setup $(if $(CI),viewer,viewer-if-possible)
	$(PYTEST) -n 2 --dist loadfile -m "not long and not thorough and not browser and not clients and not soak" $(ARGS)

# The same two processes; files in the order of their names, but for the mutants, which go last.
test-long: setup
	$(PYTEST) -n 2 --dist loadfile --no-loadscope-reorder -m "long and not browser" $(ARGS)

# The hard cases by all algorithms, at length, and other checks of minutes: for whoever changes an algorithm or a policy, and before
# docs/reports/hard-cases.md is written anew.
test-thorough: setup
	$(PYTEST) -n 2 --dist loadfile -m thorough $(ARGS)

# Without the viewer and the map clients there is nothing to test: here they have to be had.
test-browser: setup viewer $(MAP_CLIENTS) chromium
	$(PYTEST) -m browser $(or $(ARGS),tests/browser)

# One process: one service for all clients. -s, to read which versions there were.
test-clients: setup qgis nginx
	$(PYTEST) -s -m clients $(or $(ARGS),tests/clients)

# One process: what is measured is the service's time, not that of other tests.
test-soak: setup
	$(PYTEST) -m soak $(or $(ARGS),tests/soak)

# What pyproject.toml promises of old versions. Their own warnings of what has become of other packages are no failures.
LOWEST := .venv-lowest
QUICK  := tests/terrain/level tests/terrain/geo tests/terrain/ground tests/terrain/meshes tests/terrain/trees tests/terrain/gl \
          tests/api/test_settings.py tests/api/test_png.py tests/api/test_shade.py tests/api/cli tests/api/library tests/api/http
test-lowest: $(SYSTEM)
	@PYTHON=python3.11 scripts/make-venv.sh $(LOWEST)
	@$(LOWEST)/bin/python -m pip install -qq uv
	@$(LOWEST)/bin/uv pip install -q --python $(LOWEST)/bin/python --resolution lowest-direct -e '.[test]'
	$(LOWEST)/bin/python -m pytest -n 2 --dist loadfile -W default -m "not long and not thorough and not browser and not soak" $(or $(ARGS),$(QUICK))

# The other end: what a user gets who installs today, without the versions of requirements.lock.
NEWEST := .venv-newest
test-newest: $(SYSTEM)
	@PYTHON="$(or $(PYTHON),python3.13 python3.12)" scripts/make-venv.sh $(NEWEST)
	@$(NEWEST)/bin/python -m pip install -qq uv
	@$(NEWEST)/bin/uv pip install -q --python $(NEWEST)/bin/python --upgrade -e '.[test]'
	$(NEWEST)/bin/python -m pytest -n 2 --dist loadfile -W default -m "not long and not thorough and not browser and not soak" $(or $(ARGS),$(QUICK))

# For every Python and system that is allowed; without addresses, so that it serves whatever registry is asked.
lock: $(INSTALLED)
	@$(VENV)/bin/python -m pip install -qq uv
	@$(VENV)/bin/uv pip compile -q --universal --python-version 3.11 --all-extras --no-header --no-annotate --no-emit-index-url \
	    --no-emit-find-links --upgrade pyproject.toml -o requirements.lock.part
	@{ echo "# Versions that are known to work together, of everything that pyproject.toml names; written by 'make lock'."; \
	   echo "# pip install -c requirements.lock ."; cat requirements.lock.part; } > requirements.lock
	@rm requirements.lock.part

# Prints what is over its bound, to be put into COUNTEREXAMPLES of tests/hard_cases/test_properties.py.
hunt: setup
	$(VENV)/bin/python -m tests.hard_cases.hunt $(ARGS)

check: $(INSTALLED) $(SITE_TOOLS)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports --no-logo
	$(VENV)/bin/python scripts/check_words.py
	$(VENV)/bin/python -m scripts.build_site $(SITE)

# Pages, the reference that is written from the code, search. Dead links and missing anchors are failures.
docs: $(SITE_TOOLS)
	@$(VENV)/bin/python -m scripts.build_site $(SITE)

# A host of static pages serves that branch. The pages have a menu of versions there.
docs-version: $(SITE_TOOLS)
	@$(VENV)/bin/python -m scripts.build_site $(SITE) --commit-version

notebook: setup
	$(VENV)/bin/python -m pip install -qq -c requirements.lock -e '.[docs]'
	$(VENV)/bin/jupytext -q --to ipynb -o docs/a-winters-day.ipynb examples/a_winters_day.py
	$(VENV)/bin/jupyter execute --inplace docs/a-winters-day.ipynb

# For one version of Python, numba and NumPy, and any processor of x86-64-v3; others compile, as a clone does.
wheel: setup viewer
	$(VENV)/bin/python scripts/make_wheel.py $(ARGS)

# The wheel, the source distribution, both checked; the wheel in an empty environment.
release: setup viewer
	@$(VENV)/bin/python -m pip install -qq -c requirements.lock -e '.[release]'
	$(VENV)/bin/python -m scripts.make_release $(ARGS)

viewer: $(VIEWER)

viewer-if-possible: $(INSTALLED)
	@$(MAKE) --no-print-directory viewer >/dev/null 2>&1 || \
	    echo "skugga: the viewer was not built ('make viewer' says why); all else works without it" >&2

clean:
	rm -rf $(VENV) $(LOWEST) $(NEWEST) $(SITE) api/static viewer/node_modules tests/browser/clients/node_modules build dist *.egg-info

$(INSTALLED): pyproject.toml requirements.lock
	@scripts/make-venv.sh $(VENV)
	@echo "skugga: installing Python packages into $(VENV) (a minute or so)"
	@$(VENV)/bin/python -m pip install -qq -c requirements.lock -e '.[test,viewer]'
	@touch $@

$(SITE_TOOLS): $(INSTALLED)
	@echo "skugga: installing what builds the documentation site"
	@$(VENV)/bin/python -m pip install -qq -c requirements.lock -e '.[docs]'
	@touch $@

$(SYSTEM): $(INSTALLED) scripts/check_system.py
	@$(VENV)/bin/python scripts/check_system.py || { \
	    scripts/install-system-packages.sh "OpenGL without a display (EGL) does not work yet" libegl1 libgl1 libgl1-mesa-dri libexpat1 && \
	    $(VENV)/bin/python scripts/check_system.py; }
	@touch $@

chromium:
	@test -x /usr/bin/chromium || scripts/install-system-packages.sh "the tests of the viewer need Chromium" chromium

qgis:
	@/usr/bin/python3 -c "import qgis.core" 2>/dev/null && command -v gdal_translate >/dev/null || \
	    scripts/install-system-packages.sh "the tests of map clients need QGIS and GDAL's tools" python3-qgis qgis-providers gdal-bin

nginx:
	@test -x /usr/sbin/nginx || scripts/install-system-packages.sh "the tests of the cache before the service need nginx" nginx-light

# One quick retry: where the registry cannot be reached, the viewer is given up in seconds, not minutes.
$(MODULES) $(MAP_CLIENTS): %/node_modules/.package-lock.json: %/package.json %/package-lock.json | $(INSTALLED)
	@echo "skugga: installing what $* needs"
	@cd $* && $(NPM) ci --prefer-offline --fetch-retries=1 --fetch-retry-mintimeout=1000 --fetch-retry-maxtimeout=3000
	@touch $@

$(VIEWER): $(MODULES) $(VIEWER_SOURCES)
	@cd viewer && $(NPM) run --silent build -- --logLevel warn
	@touch $@
