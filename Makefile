# Two commands for users, `make run` and `make test`; the others are for developers.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WORKERS ?= auto
SEARCHES ?= 5

export OMP_NUM_THREADS ?= 1

# which build of the core runs; where it is interpreted, why
SAY_BUILD = $(BIN)/python -P -c 'from firmware_protocol.build import settle; print("the core runs", settle())'

# what the core promises, asked of the interpreted build as well, and what puts faults into its sources. Closed loops are
# not run twice: `tests/core` holds the two builds against each other to the bit
CORE_TESTS := tests/control tests/safety tests/model tests/firmware_protocol/test_codec.py tests/firmware_protocol/test_framing.py \
    tests/hardware/test_link.py tests/hardware/test_link_statistics.py tests/tools/test_fuzz_protocol.py

.PHONY: run test unhurried search check format compile model reproduction evidence clean

run: $(VENV)/.demo
	$(BIN)/python tools/demo.py

# mypy has one processor at most, and the tests leave some of two. The live tests keep time, so they have the machine for
# themselves
test: $(VENV)/.dev
	$(MAKE) --no-print-directory --jobs=2 check unhurried
	$(BIN)/python -P -m pytest -q -m live

# -P: what its owner keeps in this folder is not imported in place of a module. The core's tests run on both builds
unhurried: $(VENV)/.dev
	$(BIN)/python -P -m pytest -q -n $(WORKERS) --dist worksteal -m 'not live and not interpreted'
	TORMAG_COMPILED=0 $(BIN)/python -P -m pytest -q -n $(WORKERS) --dist worksteal -m 'not live' $(CORE_TESTS)

# other cases of every property than those of `make test`, until one fails or SEARCHES rounds are done
search: $(VENV)/.dev
	for round in $$(seq $(SEARCHES)); do \
	    $(BIN)/python -P -m pytest -q -n $(WORKERS) --dist worksteal -m 'not live' \
	        --hypothesis-profile=search || exit 1; \
	done

check: $(VENV)/.dev
	$(BIN)/python -P -m ruff check .
	$(BIN)/python -P -m ruff format --check .
	$(BIN)/python -P -m mypy

format: $(VENV)/.dev
	$(BIN)/python -P -m ruff check --fix .
	$(BIN)/python -P -m ruff format .

# after an edit of one of the compiled files; until then all of the core runs interpreted
compile: | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable .
	@$(SAY_BUILD)

# the shipped models: bench sweeps recorded from the simulated device (sample 1, with each insert), then training
model: $(VENV)/.dev
	$(BIN)/python tools/bench_sweep.py --plant sample_1 --out build/bench_sweep.csv
	$(BIN)/python tools/train_model.py build/bench_sweep.csv --element torque --insert MRE-50-40 --without-memory \
	    --rising --hidden 40 --epochs 120 --validation-share 0.2 \
	    --out tormagd/model/models/torque_mre_50_40.safetensors --plot build/training.png
	for pair in brain:10-10 cardiovascular:10-20; do \
	    $(BIN)/python tools/bench_sweep.py --plant sample_1 --scene $${pair%:*} --out build/$${pair%:*}.csv && \
	    $(BIN)/python tools/train_model.py build/$${pair%:*}.csv --element torque --insert MRE-$${pair#*:} \
	        --without-memory --rising --hidden 40 --epochs 120 --validation-share 0.2 \
	        --out tormagd/model/models/torque_mre_$$(echo $${pair#*:} | tr - _).safetensors || exit 1; \
	done

# docs/reproduction.md and docs/learned_inverse.md with their plots: the thesis's tables and figures beside ours
reproduction: $(VENV)/.dev
	$(BIN)/python tools/reproduce_thesis.py
	$(BIN)/python tools/tactile_experiment.py --out docs

# docs/evidence: fuzz, fault matrix, numerics, replug and soak in full (well over an hour); `make test` samples them
evidence: $(VENV)/.dev
	$(BIN)/python tools/evidence.py

clean:
	rm -rf $(VENV) build run .mypy_cache .ruff_cache .pytest_cache .hypothesis

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: pyproject.toml setup.py | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[demo]'
	@$(SAY_BUILD)
	touch $@

$(VENV)/.dev: pyproject.toml setup.py | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	@$(SAY_BUILD)
	touch $@ $(VENV)/.demo
