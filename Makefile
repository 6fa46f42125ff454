# Two commands for a newcomer: `make demo` and `make test`. Each makes its own .venv from pyproject.toml.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
.DEFAULT_GOAL := help
comma := ,
# The package with some of its extras, by uv if it is installed, otherwise by pip; an environment that uv made has no pip.
install = if command -v uv >/dev/null 2>&1; then uv pip install --quiet --python $(BIN)/python -e '.[$(1)]'; \
	else { test -x $(BIN)/pip || $(BIN)/python -m ensurepip >/dev/null; } \
	  && $(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[$(1)]'; fi
# Oracles of the tests without their dependencies: opencv-python, which TrackEval wants, would overwrite the headless
# OpenCV, and of evo (GPL, which no part of the package imports) the tests need only the readers and errors.
oracles = 'trackeval>=1.3' 'evo>=1.38'
oracle = if command -v uv >/dev/null 2>&1; then uv pip install --quiet --python $(BIN)/python --no-deps $(oracles); \
	else $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps $(oracles); fi

failed = echo "psotrack: set-up failed: the packages of pyproject.toml could not be installed into $(VENV) (see above); remove $(VENV) to start anew" >&2

# One worker per processor; a worker that has finished takes tests of another. Bytecode is kept between runs, because
# every worker and every command that a test starts would compile the package again.
pytest = env -u PYTHONDONTWRITEBYTECODE $(BIN)/python -m pytest -n auto --dist worksteal

.PHONY: help demo test test-slow nightly real fuzz kills mutants network lint format size bench bench-videos bench-live bench-batch notebooks table4 table5 table5-quick table7 docs results reference-flights clean

help:  ## list the targets
	@grep -hE '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 18

$(VENV)/.package: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	  || { echo "psotrack: set-up failed: '$(PYTHON)' is not Python 3.11 or newer; name one, e.g. make PYTHON=python3.12" >&2; exit 1; }
	@echo "psotrack: making a Python environment in $(VENV)"
	@{ if command -v uv >/dev/null 2>&1; then \
	    test -d $(VENV) || uv venv --quiet --python $(PYTHON) $(VENV); \
	  else \
	    test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV); \
	  fi \
	  && echo "psotrack: installing psotrack, its libraries (JAX, OpenCV, SciPy, pandas and more) and its viewer: 1.7 GB on the disk, some minutes" \
	  && $(call install,view); } || { $(failed); exit 1; }
	@touch $@

$(VENV)/.installed: $(VENV)/.package
	@echo "psotrack: installing what tests and lint need (Hypothesis, Jupyter, Playwright, ruff, mypy and more): 0.6 GB more, a minute or two"
	@{ $(call install,test$(comma)lint) && $(oracle); } || { $(failed); exit 1; }
	@touch $@

demo: $(VENV)/.package  ## simulate four drones, track them from the videos, print the errors, save a picture in demo/
	@$(BIN)/psotrack demo --out demo --force

test: $(VENV)/.installed  ## the fast tests, some minutes; NAMES="tests/recordings/test_video.py ..." for some files
	@$(pytest) -m 'not slow and not nightly' $(NAMES)

test-slow: $(VENV)/.installed  ## the slow tests: whole programs and experiments at small sizes
	@$(pytest) -m 'slow and not nightly' $(NAMES)

nightly: $(VENV)/.installed  ## what takes long and finds little: the fast tests with types checked, nightly tests, fuzz, kills
	@PSOTRACK_TYPE_CHECKS=on $(pytest) -m 'not slow and not nightly' $(NAMES)
	@$(pytest) -m nightly $(NAMES)
	@$(MAKE) --no-print-directory fuzz kills

real: $(VENV)/.installed  ## the tests on other people's recordings below PSOTRACK_REAL_DATA; says which are not there
	@$(BIN)/python tests/real_data.py
	@$(pytest) -m real $(NAMES)

fuzz: $(VENV)/.installed  ## damaged files for every reader, three minutes; MINUTES=60 for more, SEED=7 for others
	@PYTHONPATH=tests $(BIN)/python -m fuzz $(if $(MINUTES),--minutes $(MINUTES)) $(if $(SEED),--seed $(SEED))

kills: $(VENV)/.installed  ## kill commands at random moments and run them again; COUNT=1000 for more, SEED=7 for others
	@$(BIN)/python experiments/kills.py --count $(or $(COUNT),300) --seed $(or $(SEED),0) --out build/kills-$(or $(SEED),0)

mutants: $(VENV)/.installed  ## how many changed lines of the package the tests notice: hours; goes on where it was stopped
	@$(call install,mutants)
	@test -f build/mutants/seconds.tsv || $(BIN)/python tests/mutants.py cover
	@$(BIN)/python tests/mutants.py run

lint: $(VENV)/.installed  ## ruff, its format check, mypy
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy

format: $(VENV)/.installed  ## let ruff mend and format
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

size:  ## lines of code per room, and their budgets
	@$(PYTHON) experiments/size.py

network: $(VENV)/.installed  ## train the network that finds drones: two hours
	@$(BIN)/python experiments/network.py $(if $(DATA),--data $(DATA))

bench: bench-videos  ## from videos to tracks, stage by stage: as fast as the cameras?

bench-videos bench-live bench-batch: $(VENV)/.installed  ## from videos to tracks; live; many runs at once: some minutes each
	@$(BIN)/python experiments/benchmark.py $(@:bench-%=%) $(if $(DATA),--data $(DATA))

notebooks: $(VENV)/.installed  ## run the notebooks and write them with their output; commit the changed files
	@cd notebooks && ../$(BIN)/python _refresh.py

table5: $(VENV)/.installed  ## the paper's Table 5 beside ours, an hour; DATA=FOLDER for the published sequences
	@$(BIN)/python experiments/table5/table5.py $(if $(DATA),--data $(DATA))

table4: $(VENV)/.installed  ## the paper's Table 4: projection lines, beside the swarm; DATA=FOLDER for the published sequences, DETECTOR=trained for a network's detections too
	@$(BIN)/python experiments/table4/table4.py $(if $(DATA),--data $(DATA)) $(if $(DETECTOR),--detector $(DETECTOR))

table5-quick: $(VENV)/.installed  ## a small form of Table 5: the smallest and the largest swarms, ten minutes
	@$(BIN)/python experiments/table5/table5.py --quick $(if $(DATA),--data $(DATA))

table7: $(VENV)/.installed  ## the paper's Tables 6 to 8 and figure 11: drones' own cameras and markers; DATA=FOLDER for the published sequences
	@$(BIN)/python experiments/table7/table7.py $(if $(DATA),--data $(DATA))

docs: $(VENV)/.installed  ## build the documentation into build/docs; fails on a warning and on a figure of another version of tracking
	@$(call install,docs)
	@$(BIN)/python docs/readme.py --check
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict --config-file docs/mkdocs.yml
	@echo "build/docs/index.html"

results: $(VENV)/.installed  ## make the headline figures again, less than two hours; ONLY=table4 for one
	@$(BIN)/python experiments/_results.py make $(ONLY)
	@$(BIN)/python docs/readme.py

reference-flights: $(VENV)/.installed  ## write the numbers of three small flights anew, after a change of the results that is meant
	@$(BIN)/python experiments/reference_flights.py --write

clean:  ## remove what was built, the environment too
	rm -rf $(VENV) build dist demo notebooks/data ./*.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .compiled
