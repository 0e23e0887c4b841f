# Everything runs in .venv, made from Python 3.11 (pybullet has wheels up to 3.11 only).
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
# What the programs need, and what developing needs besides.
STAMP := $(VENV)/.installed
DEV := $(VENV)/.installed-dev
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1

.PHONY: help demo kinematics dynamics watch thesis test test-all coverage safety mutants check bench clean

help:
	@echo "make demo    a simulated arm identifies itself over Zenoh in processes of its own, and is scored"
	@echo "make kinematics  the thesis' estimator, ours and the physical limit, every row in about a minute"
	@echo "make dynamics    inertia, payloads, torque control and monitoring, every row in about a minute"
	@echo "make watch   a night: 100 hours of everyday use under the monitor, and changes that grow slowly"
	@echo "make thesis  the thesis' experiments side by side with what was printed, few trials, under three minutes"
	@echo "make test    the tests that a merge must pass"
	@echo "make test-all  these, and further robots, seeds and settings of what they tell; half as long again"
	@echo "make coverage  branch coverage of what runs in one process"
	@echo "make safety  branch coverage of the safety core, which must be whole"
	@echo "make mutants every change of the safety core that its tests do not notice; two hours, goes on where it stopped"
	@echo "make check   format, lint, types, floors and doors"
	@echo "make bench   benchmarks"
	@echo "make clean   remove .venv and caches; runs/ stays"

$(BIN)/python:
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; v == (3, 11) or sys.exit("Python 3.11 is needed, this is %d.%d: pybullet has no wheels beyond it. Try: make PYTHON=/path/to/python3.11" % v)'
	@$(PYTHON) -m venv $(VENV)

$(STAMP): pyproject.toml | $(BIN)/python
	@echo "Installing the programs into $(VENV): one to two minutes, about 1.4 GB."
	@$(PIP) -e '.[all]'
	@echo "Compiling the numerical kernels, once: about a minute."
	@$(BIN)/x5-sim compile
	@touch $@

$(DEV): pyproject.toml $(STAMP)
	@echo "Installing what developing needs: about a minute, 1 GB more."
	@$(PIP) -e '.[dev]'
	@# HEBI's library asks for an older numpy than it needs; without it a few tests are skipped.
	@$(PIP) --no-deps hebi-py==2.16.1 || echo "hebi-py is not installed: its tests are skipped"
	@touch $@

demo: $(STAMP)
	@rm -rf runs/demo
	@echo "Four modules identify their arm in real time: about two minutes."
	$(BIN)/x5-sim run a2085_04 --network lan --out runs/demo
	@echo "Read it: runs/demo/report.html; look at it: $(BIN)/rerun runs/demo/session.rrd"

kinematics: $(STAMP)
	@mkdir -p runs
	$(BIN)/x5-sim benchmark kinematics --quick --json runs/kinematics.json

dynamics: $(DEV)
	@mkdir -p runs
	$(BIN)/x5-sim benchmark dynamics --quick --json runs/dynamics.json $(if $(TX40),--tx40 $(TX40))

# A night: what is over is kept, and the same command continues.
watch: $(STAMP)
	@mkdir -p runs
	$(BIN)/x5-sim watch --hours 100 --trials 3 --out runs/watch --json runs/watch.json

thesis: $(STAMP)
	$(BIN)/x5-sim thesis --quick --out runs/thesis
	@echo "Read it: runs/thesis/report.html"

# Processes in real time have the machine to themselves: next to other work their messages come too late.
test: LEFT_OUT := benchmark or breadth
test-all: LEFT_OUT := benchmark
test test-all: $(DEV)
	$(BIN)/python -m pytest -n 2 --dist loadgroup -m "not (integration or $(LEFT_OUT))"
	$(BIN)/python -m pytest -m "integration and not ($(LEFT_OUT))"

# Processes of their own and compiled kernels are not counted; tracing makes everything about twice as slow.
coverage: $(DEV)
	$(BIN)/python -m pytest -n 2 --dist loadgroup --ignore tests/integration --ignore tests/simulation \
		--cov module_agent --cov coordinator --cov sim --cov-branch --cov-report term:skip-covered

safety: $(DEV)
	$(BIN)/python -m tests.safety_core coverage

mutants: $(DEV)
	$(BIN)/python -m tests.safety_core mutants
	$(BIN)/python -m tests.safety_core kernel

check: $(DEV)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(DEV)
	$(BIN)/python -m pytest -m benchmark -s tests/benchmarks

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache
