# Works on a bare clone: needs Python 3.10 or newer with venv, bash and make, and on the first run the network.

PYTHON ?= python3
SLICES ?= 30
DEMO_OUTPUT ?= build/demo.png
PYTEST_ARGS ?=
BENCH_ARGS ?=
MINUTES ?= 60
INPUTS ?= 10000
FUZZ_ARGS ?=
MUTANTS_ARGS ?=
MATRIX_TESTS ?=

SHELL := bash
# Not -u: colcon's setup.bash reads variables that nobody has set.
.SHELLFLAGS := -eo pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

# Libraries of another ROS 2 must not be mixed with those in .venv, be it an installation that was sourced or the wheels
# of another environment, which pass a guard variable on to their children.
ifneq ($(_ROS_WHEELS_BOOTSTRAP_COMPLETE)$(AMENT_PREFIX_PATH),)
unexport LD_LIBRARY_PATH
endif
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH
unexport PYTHONPATH PYTHONHOME ROS_DISTRO RMW_IMPLEMENTATION

export PIP_DISABLE_PIP_VERSION_CHECK := 1

# A stamp is written when its step has succeeded, so a step that was interrupted is done again.
INSTALLED := .venv/.installed
LINKED := .venv/.linked
BUILT := install/.built
CATPHAN := .cache/catphan/.complete
DEBIAN := .cache/.debian

EXECUTABLES := install/stereoreg_ros/lib/stereoreg_ros
# Folders count too: theirs is the date that changes when a file is removed.
SOURCES := $(shell find stereoreg_ros config launch resource -name __pycache__ -prune -o -print 2>/dev/null) \
           setup.py setup.cfg package.xml LICENSE
# The wheels' own packages are found under .venv. Nobody else on the network is to hear a demonstration or a test.
WITH_ROS := export AMENT_PREFIX_PATH='$(CURDIR)/.venv' ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST; \
            source install/setup.bash;

.PHONY: help venv demo test colcon-test matrix docs lint bench soak fuzz mutants catphan debian clean distclean

help:
	@echo 'make venv       set up .venv (Python, ROS 2 wheels, tools) and build the package to install/'
	@echo 'make demo       simulated scanner and registration as two processes; SLICES=$(SLICES) DEMO_OUTPUT=$(DEMO_OUTPUT)'
	@echo 'make test       all tests, in two processes; PYTEST_ARGS="-k word" to choose, in one'
	@echo 'make colcon-test  the tests of the core as colcon runs them'
	@echo 'make matrix     the most telling tests on other versions: Ubuntu 24.04, the newest, ROS 2 Kilted; MATRIX_TESTS=...'
	@echo 'make docs       the documentation as a site: build/docs/index.html'
	@echo 'make lint       style and types'
	@echo 'make bench      measurements'
	@echo 'make soak       slices at 20 Hz for MINUTES=$(MINUTES): what is lost, whether memory or latency grows; build/soak/soak.png'
	@echo 'make fuzz       hostile input of every kind; INPUTS=$(INPUTS) of each, FUZZ_ARGS="frame dicom --seed 1" to choose'
	@echo 'make mutants    bugs put into a copy of the code, one at a time: whether the tests notice; MUTANTS_ARGS="--quick" or words'
	@echo 'make clean      remove what was built; make distclean: .venv and downloads too'
	@echo 'PYTHON=python3.12 make venv   chooses the Python of a new .venv'

venv: $(LINKED) $(BUILT)

$(INSTALLED): requirements.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { echo "make: expected Python 3.10 or newer," \
	    "found PYTHON=$(PYTHON): $$($(PYTHON) --version 2>&1); name another with PYTHON=..." >&2; exit 1; }
	@echo 'Setting up .venv: about 800 MB on disk, a minute or two'
	$(PYTHON) -m venv --clear .venv
	.venv/bin/python -m pip install --quiet --requirement requirements.txt
	@touch $@

# Benchmarks and fuzzer share test/support with the tests.
$(LINKED): $(INSTALLED) setup.py setup.cfg
	.venv/bin/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@echo '$(CURDIR)/test' > "$$(.venv/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/stereoreg_ros_test.pth"
	@touch $@

# From nothing, so that a removed module is not found in an old build.
$(BUILT): $(INSTALLED) $(SOURCES) | $(LINKED)
	rm -rf build/stereoreg_ros install
	.venv/bin/colcon build --paths . --event-handlers console_direct- console_stderr+
	@touch $@

catphan: $(CATPHAN)

$(CATPHAN): test/support/fetch_catphan.py | $(INSTALLED)
	.venv/bin/python test/support/fetch_catphan.py $(@D)
	@touch $@

debian: $(DEBIAN)

# For the tests: real DICOM clients, and ip, to make hosts of their own. Where they cannot be installed, the tests that need
# them are skipped and say so.
$(DEBIAN):
	@mkdir -p $(@D)
	@for need in storescu:dcmtk ip:iproute2; do \
	    command -v $${need%:*} >/dev/null || { echo "Installing $${need#*:}" && [ "$$(id -u)" = 0 ] && apt-get update -qq && \
	    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $${need#*:} >/dev/null; } || \
	    echo "make: $${need#*:} cannot be installed here, nothing is tested with it"; \
	done
	@touch $@

demo: venv
	@mkdir -p '$(dir $(DEMO_OUTPUT))'
	$(WITH_ROS) $(EXECUTABLES)/demo_report --slices $(SLICES) --output '$(DEMO_OUTPUT)'

# Two processes on two cores: threads of OpenBLAS would only get in each other's way. By default xdist runs the files with
# the fewest tests last, and here those tests take the longest.
TEST_ALL := --numprocesses 2 --dist loadfile --no-loadscope-reorder
test: venv catphan debian
	$(WITH_ROS) OPENBLAS_NUM_THREADS=1 .venv/bin/python -m pytest $(or $(PYTEST_ARGS),$(TEST_ALL))

# colcon test is content where no test ran.
colcon-test: venv
	.ci/colcon-test

matrix: $(INSTALLED)
	.ci/matrix/run $(MATRIX_TESTS)

docs: $(INSTALLED)
	rm -rf build/docs
	.venv/bin/python -m sphinx --quiet --fail-on-warning --keep-going --builder html docs build/docs
	@echo 'build/docs/index.html'

lint: $(INSTALLED)
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

# On one core: matrices of six rods gain nothing from several.
bench: venv
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 .venv/bin/python -m benchmarks $(BENCH_ARGS)

soak: venv
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 .venv/bin/python -m benchmarks.soak --minutes $(MINUTES)

# Findings are laid into test/corpus, where the tests try them again.
fuzz: venv
	export AMENT_PREFIX_PATH='$(CURDIR)/.venv' ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST OPENBLAS_NUM_THREADS=1; \
	    .venv/bin/python -m fuzzing $(FUZZ_ARGS) --inputs $(INPUTS)

# Nothing of it stays: the copies are made in a temporary folder.
mutants: $(INSTALLED)
	.venv/bin/python -m mutants $(MUTANTS_ARGS)

clean:
	rm -rf build install log *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -path ./.venv -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean
	rm -rf .venv .cache .matrix
