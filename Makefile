# make demo   sets up and runs the main job on the example
# make test   sets up, checks style and types, runs the tests
# make extras installs what recal, serve, --cluster, dcc.xml and the compiled kernels need in addition
# make texts  writes the catalogues of texts again (CONTRIBUTING.md), and lists what has no translation
# make options writes the tables of options in docs/commands.md again
# make pins   writes the pinned dependencies again (CONTRIBUTING.md)
# make sbom   writes the bill of materials of the wheel again, from the pins and the version
# make release builds wheel and source in dist/, checks both, and looks up known vulnerabilities of the pins
# make bench  prints the ratios against named peers
# make second      runs the tests of the chain with a second Python, where one is found
# make coverage    runs the tests and prints their branch coverage
# make docs        builds the documentation site in docs-out/; make docs-links follows its links to other sites
PYTHON ?= python3
BIN := .venv/bin
TEXTS := $(patsubst %.po,%.mo,$(wildcard templates/_language/*.po))
CONTROLLERS := isg-csv etalon-exchange siemens-eec siemens-cec fanuc-pitch

DOCS := .venv-docs/bin
RELEASE := .venv-release/bin

# a module is compiled when it is first imported: to compile all of them takes longer than to install them
PIP_INSTALL := -m pip install --quiet --disable-pip-version-check --no-compile
PIP := $(BIN)/python $(PIP_INSTALL)
PIP_DOCS := $(DOCS)/python $(PIP_INSTALL)
PIP_RELEASE := $(RELEASE)/python $(PIP_INSTALL)
COMPILE = uv pip compile --quiet --no-strip-extras --universal --python-version 3.11 --generate-hashes --custom-compile-command "make pins"

# the tests of a file go to one process, which then prepares once what they share; three processes for two processors, because
# some tests wait (for LinuxCNC, a browser, other processes); in the order of tests/conftest.py; a process that is lost is not
# replaced: its successor would begin with the same test, again and again where that one does not end
SPREAD := -n 3 --dist loadfile --no-loadscope-reorder --max-worker-restart=0

# the tests start some hundred processes: each would compile all modules again
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo extras test lint second system bench coverage docs docs-links texts options pins sbom release clean
.DELETE_ON_ERROR:

demo: .venv/ready $(TEXTS)
	$(BIN)/volcomp run zha-gantry examples/zha-gantry.lengths.csv $(foreach name,$(CONTROLLERS),--controller $(name)) --out demo-out
	$(BIN)/python examples/against_truth.py demo-out

extras: .venv/ready-extras

# as a command does it (compgen/cli): a second thread of the numerical libraries only waits, and keeps a processor busy
test coverage: export OPENBLAS_NUM_THREADS ?= 1
test coverage: export MKL_NUM_THREADS ?= 1

test: lint system $(TEXTS)
	$(BIN)/python -m pytest $(SPREAD) -ra

# as the tests of `make test`; the figures are those of all processes together
coverage: .venv/ready-dev system $(TEXTS)
	$(BIN)/python -m pytest $(SPREAD) -q --cov=compgen --cov-branch --cov-report=term

# programs of the system that some tests run against; those tests are skipped by name where they cannot be installed
system:
	@.ci/system-packages

second: .venv/ready-dev
	@.ci/second-python

lint: .venv/ready-dev
	$(BIN)/ruff check compgen tests examples docs benchmarks
	$(BIN)/ruff format --check compgen tests examples docs benchmarks
	$(BIN)/mypy

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "compgen needs Python 3.11 or newer: make PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -m venv .venv || { rm -rf .venv; \
	  [ "$$(id -u)" = 0 ] && apt-get install -y -qq python3-venv && $(PYTHON) -m venv .venv; } || \
	  { rm -rf .venv; echo "no virtual environment: install your system's python3-venv package"; exit 1; }

.venv/ready: .venv/bin/python requirements.txt pyproject.toml
	$(PIP) --require-hashes -r requirements.txt
	$(PIP) --no-build-isolation --no-deps -e .
	@touch $@

# the installation has compiled the catalogues of texts; again after a change
%.mo: %.po | .venv/ready
	@$(BIN)/python hatch_build.py

.venv/ready-extras: .venv/ready requirements-extras.txt
	$(PIP) --require-hashes -r requirements-extras.txt
	@touch $@

# these contain the extras
.venv/ready-dev: .venv/ready requirements-dev.txt
	$(PIP) --require-hashes -r requirements-dev.txt
	@touch $@

# the site has an environment of its own: nothing of it is installed for the demo or the tests
.venv-docs/ready: .venv/bin/python requirements.txt requirements-extras.txt requirements-docs.txt pyproject.toml
	@[ -x $(DOCS)/python ] || $(BIN)/python -m venv .venv-docs
	$(PIP_DOCS) --require-hashes -r requirements.txt
	$(PIP_DOCS) --require-hashes -r requirements-extras.txt
	$(PIP_DOCS) --require-hashes -r requirements-docs.txt
	$(PIP_DOCS) --no-build-isolation --no-deps -e .
	@touch $@

# a warning is an error; links within the site are checked, also their headings
docs: .venv-docs/ready
	$(DOCS)/python -m sphinx -W --keep-going -q -b html docs docs-out
	@echo "docs-out/index.html"

# links to other sites: apart, because it needs the network
docs-links: .venv-docs/ready
	$(DOCS)/python -m sphinx -q -b linkcheck docs docs-out/links

# every benchmark, one after the other, that of the diagnosis in short; some minutes on a quiet computer
bench: .venv/ready-dev
	for name in identify evaluate fit interval_coverage; do $(BIN)/python benchmarks/$$name.py || exit 1; done
	$(BIN)/python benchmarks/diagnosis.py --sets 2
	$(BIN)/python benchmarks/endtoend.py

texts: .venv/ready-dev
	$(BIN)/python tests/texts/extraction.py

options: .venv/ready-extras
	$(BIN)/python docs/option_tables.py

# pins stay as they are unless UPGRADE names a package: make pins UPGRADE="--upgrade-package numpy"
pins:
	$(COMPILE) $(UPGRADE) --extra plot pyproject.toml requirements.in -o requirements.txt
	$(COMPILE) $(UPGRADE) --all-extras -c requirements.txt pyproject.toml -o requirements-extras.txt
	$(COMPILE) $(UPGRADE) --all-extras -c requirements.txt -c requirements-extras.txt pyproject.toml requirements-dev.in -o requirements-dev.txt
	$(COMPILE) $(UPGRADE) -c requirements.txt -c requirements-extras.txt requirements-docs.in -o requirements-docs.txt
	$(COMPILE) $(UPGRADE) -c requirements.txt -c requirements-extras.txt -c requirements-dev.txt requirements-release.in -o requirements-release.txt
	$(PYTHON) .ci/sbom.py

sbom:
	$(PYTHON) .ci/sbom.py

# what makes a release has an environment of its own, as the site has
.venv-release/ready: .venv/bin/python requirements-release.txt
	@[ -x $(RELEASE)/python ] || $(BIN)/python -m venv .venv-release
	$(PIP_RELEASE) --require-hashes -r requirements-release.txt
	@touch $@

# the wheel is built from the source archive, so that this is known to be whole
release: .venv-release/ready sbom
	@git diff --quiet -- compgen/sbom.cdx.json || echo "compgen/sbom.cdx.json has changed: commit it"
	rm -rf dist
	$(RELEASE)/python -m build --no-isolation --outdir dist .
	$(RELEASE)/python -m twine check --strict dist/*
	$(RELEASE)/python .ci/check-sbom.py dist/*.whl
	.ci/audit $(RELEASE)/pip-audit requirements-extras.txt

clean:
	rm -rf .venv .venv-docs .venv-release .venv-second demo-out docs-out dist .coverage
