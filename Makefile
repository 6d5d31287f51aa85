# Two commands for users, `make run` and `make test`, and `make install` beside a console (systemd/README.md); the others are
# for developers.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WORKERS ?= auto
PYTHONS ?= 3.11 3.12 3.13
GOAL ?= test
SEARCHES ?= 5
SEED ?= 1
PLANT ?= sample_1
SECONDS ?= 12
MATRICES ?= 10 30 50

DESTDIR ?=
PREFIX ?= /usr/local
LIBRARY := $(PREFIX)/lib/tormagd
# what the service's users have besides: recordings, their pictures, and what they look at it with
SERVICE_EXTRAS ?= record,plot,top,dashboard,metrics

export OMP_NUM_THREADS ?= 1
# each of the many processes that a test starts would compile all that it imports
unexport PYTHONDONTWRITEBYTECODE

# which build of the core runs; where it is interpreted, why
SAY_BUILD = $(BIN)/python -P -c 'from firmware_protocol.build import settle; print("the core runs", settle())'

# what the core promises, asked of the interpreted build as well. Closed loops are
# not run twice: `tests/core` holds the two builds against each other to the bit
CORE_TESTS := tests/control tests/assembly tests/safety tests/model tests/firmware_protocol/test_codec.py \
    tests/firmware_protocol/test_framing.py tests/hardware/test_link.py tests/hardware/test_link_statistics.py

# the variable: mkdocs-material's notice of its own end of life, 2027, is no warning of ours
SITE = NO_MKDOCS_2_WARNING=1 $(BIN)/python -P -m mkdocs build --strict

PIP_TO := $(BIN)/python -m pip install --quiet --no-warn-script-location --upgrade --target

.PHONY: install uninstall deb wheels parts run test compiled live yielding interpreted fuzz coverage search pythons check docs format compile core fetched model tactile-model reproduction evidence clean

run: $(VENV)/.demo
	$(BIN)/python tools/demo.py --plant '$(PLANT)'

test: $(VENV)/.dev
	$(MAKE) --no-print-directory compiled
	$(MAKE) --no-print-directory --jobs=2 live yielding

# real processes in real time, one test after the other: they wait more than they work, and what is checked beside them
# gives way
live: $(VENV)/.dev
	$(BIN)/python -P -m pytest -q -m live $$(grep -rlE 'mark\.live' tests --include='test_*.py')

yielding: $(VENV)/.dev
	nice -n 19 $(MAKE) --no-print-directory --jobs=2 check fuzz interpreted WORKERS=0

# -P: what its owner keeps in this folder is not imported in place of a module
compiled: $(VENV)/.dev
	$(BIN)/python -P -m pytest -q -n $(WORKERS) --dist worksteal -m 'not live'

# the core's tests on the other build
interpreted: $(VENV)/.dev
	TORMAG_COMPILED=0 $(BIN)/python -P -m pytest -q -n $(WORKERS) --dist worksteal -m 'not live and not long' $(CORE_TESTS)

# the firmware's sources under libFuzzer and sanitizers for so many seconds; where clang is not there, that is said
fuzz: $(VENV)/.dev
	$(BIN)/python tools/judge.py endure fuzz --count $(SECONDS) --seed $(SEED)

# which lines of the packages the tests without real time run; nothing compiled is seen, so the rooms that are compiled in
# part are asked again, interpreted. pyproject.toml has the least share
coverage: $(VENV)/.dev
	$(BIN)/python -P -m pytest -q -n $(WORKERS) --dist worksteal -m 'not live' \
	    --cov --cov-report= --cov-fail-under=0
	TORMAG_COMPILED=0 $(BIN)/python -P -m pytest -q -n $(WORKERS) --dist worksteal -m 'not live' --cov --cov-append \
	    $(CORE_TESTS) tests/physics tests/inverse tests/hardware tests/simulation \
	    $(patsubst %,tests/daemon/test_%.py,rate_group source telemetry)

# other cases of every property than those of `make test`, until one fails or SEARCHES rounds are done
search: $(VENV)/.dev
	for round in $$(seq $(SEARCHES)); do \
	    $(BIN)/python -P -m pytest -q -n $(WORKERS) --dist worksteal -m 'not live' \
	        --hypothesis-profile=search || exit 1; \
	done

# what is committed, from nothing, with every supported Python; one that is not here is named
pythons:
	for version in $(PYTHONS); do \
	    if ! python$$version -c '' 2>/dev/null; then echo "python$$version is not here: not tried"; continue; fi; \
	    rm -rf build/python$$version && git clone --quiet . build/python$$version && \
	    $(MAKE) --no-print-directory -C build/python$$version $(GOAL) PYTHON=python$$version || exit 1; \
	done

check: $(VENV)/.dev
	$(BIN)/python -P -m ruff check .
	$(BIN)/python -P -m ruff format --check .
	$(BIN)/python -P -m mypy
	$(BIN)/python -P tools/house.py
	$(SITE) --site-dir build/checked_site

# the documentation as a site, in build/site
docs: $(VENV)/.dev
	$(SITE)

format: $(VENV)/.dev
	$(BIN)/python -P -m ruff check --fix .
	$(BIN)/python -P -m ruff format .

# after an edit of one of the compiled files; until then all of the core runs interpreted
compile: core
	@$(SAY_BUILD)

# the shipped models, one for the inserts of a matrix: bench sweeps recorded from the simulated device (sample 1), then training
model: $(VENV)/.dev
	for matrix in $(MATRICES); do \
	    inserts=$$(printf "MRE-$$matrix-%s " 10 20 30 40) && \
	    $(BIN)/tormag-lab bench-sweep --plant sample_1 --insert $$inserts --out build/mre_$$matrix.csv && \
	    $(BIN)/tormag-lab train-model build/mre_$$matrix.csv --element torque --insert $$inserts --without-memory \
	        --rising --hidden 50 --epochs 200 --validation-share 0.2 \
	        --out tormagd/element/model/models/torque_mre_$$matrix.safetensors || exit 1; \
	done

# the shipped model of the tactile pad: cycles and holds of the simulated pad 1 on the bench, then training
tactile-model: $(VENV)/.dev
	$(BIN)/tormag-lab tactile-model --out tormagd/element/model/models/tactile_mre_c.safetensors

# docs/reproduction.md and docs/learned_inverse.md with their plots: the thesis's tables and figures beside ours
reproduction: $(VENV)/.dev
	$(BIN)/tormag-lab reproduce-thesis --out docs

# docs/evidence: the judges and the benchmarks in full (well over an hour); `make test` samples them
evidence: $(VENV)/.dev
	$(BIN)/python tools/evidence.py

# The library stands in one folder of its own, with all that it imports, so that it can be put under any DESTDIR; both
# commands find it there. It is built for, and run by, the interpreter that PYTHON names.
install: $(VENV)/.man
	rm -rf '$(DESTDIR)$(LIBRARY)'
	$(PIP_TO) '$(DESTDIR)$(LIBRARY)' ./client '.[$(SERVICE_EXTRAS)]' ./lab
	rm -rf '$(DESTDIR)$(LIBRARY)/bin'
	BUILD_PYTHON=$(BIN)/python BUILD_LIBRARY='$(DESTDIR)$(LIBRARY)' \
	    systemd/install.sh '$(DESTDIR)' '$(PREFIX)' "$$(command -v $(PYTHON))" '$(LIBRARY)'

# leaves the configuration and what was recorded
uninstall:
	rm -rf $(addprefix '$(DESTDIR)$(PREFIX)'/,lib/tormagd share/tormagd share/doc/tormagd bin/tormagd bin/tormagctl bin/tormag-lab) \
	    '$(DESTDIR)$(PREFIX)'/lib/systemd/system/tormag* '$(DESTDIR)$(PREFIX)'/lib/*/tormag.conf \
	    '$(DESTDIR)$(PREFIX)'/lib/udev/rules.d/60-tormag.rules '$(DESTDIR)$(PREFIX)'/share/man/man1/tormag* \
	    '$(DESTDIR)$(PREFIX)'/share/bash-completion/completions/tormagctl \
	    '$(DESTDIR)$(PREFIX)'/share/zsh/site-functions/_tormagctl

# the three distributions in build/wheels, to be installed together: pip install build/wheels/*.whl
wheels: | $(BIN)/python
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir build/wheels ./client . ./lab

# each distribution's tests where nothing but it, what it needs and what its tests need is installed
parts: $(addprefix part-,client tormagd lab)
part-client: WHEELS = $$(echo build/wheels/tormagd_client-*.whl)
part-client: TESTS = client/tests
part-tormagd: WHEELS = $$(echo build/wheels/tormagd_client-*.whl build/wheels/tormagd-*.whl)[man,test]
part-tormagd: TESTS = tests --ignore tests/tools --ignore tests/docs
part-lab: WHEELS = $$(echo build/wheels/tormagd*.whl build/wheels/tormag_lab-*.whl)[all]
part-lab: TESTS = lab/tests
part-%: wheels
	@echo "$*: a new environment in build/parts/$*"
	$(PYTHON) -m venv --clear build/parts/$*
	build/parts/$*/bin/python -m pip install --quiet --no-compile $(WHEELS) hypothesis mpmath pytest pytest-timeout
	build/parts/$*/bin/python -P -m pytest -m 'not live' $(TESTS)

# a Debian package in build/, for the Python of this Debian, with this Debian's packages and, inside, what systemd/bundled.txt locks
deb: $(VENV)/.man
	@$(BIN)/python -c 'import sys; sys.exit(None if sys.base_prefix == "/usr" else \
	    "the package is for Debian\x27s own Python: make clean, make deb PYTHON=/usr/bin/python3")'
	rm -rf build/library
	$(PIP_TO) build/library --no-compile --no-deps ./client . ./lab
	$(PIP_TO) build/library --no-compile --no-deps --only-binary :all: --require-hashes --requirement systemd/bundled.txt
	rm -rf build/library/bin
	BUILD_PYTHON=$(BIN)/python BUILD_LIBRARY='$(CURDIR)/build/library:/usr/lib/python3/dist-packages' systemd/deb.sh build/library build

clean:
	rm -rf $(VENV) build run .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage*

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: pyproject.toml client/pyproject.toml lab/pyproject.toml setup.py | $(BIN)/python
	$(MAKE) --no-print-directory --jobs=2 core fetched EXTRAS=demo
	@$(SAY_BUILD)
	touch $@

$(VENV)/.man: pyproject.toml client/pyproject.toml lab/pyproject.toml setup.py | $(BIN)/python
	$(BIN)/python -m pip install --quiet 'argparse-manpage>=4.6' 'shtab>=1.7'
	touch $@

$(VENV)/.dev: pyproject.toml client/pyproject.toml lab/pyproject.toml setup.py | $(BIN)/python
	$(MAKE) --no-print-directory --jobs=2 core fetched EXTRAS='dev all'
	@$(SAY_BUILD)
	touch $@ $(VENV)/.demo

# the core is compiled while what it needs is fetched, which waits for the network and the disk
core: | $(BIN)/python
	$(BIN)/python -m pip install --quiet --no-deps --editable client --editable . --editable lab

# --no-compile: pip would compile every module of torch, SciPy and PyArrow, where few are imported
fetched: | $(BIN)/python
	$(BIN)/python tools/dependencies.py $(EXTRAS) > $(VENV)/requirements.txt
	$(BIN)/python -m pip install --quiet --no-compile --requirement $(VENV)/requirements.txt
