# make demo: from nothing to a better robot.   make lab: to open notebooks.   make test: to all tests.

VENV := .venv
PY := $(VENV)/bin/python
SCALE ?= reduced
NOTEBOOKS ?= $(wildcard notebooks/*.ipynb)
LAB_ARGS ?=
# Two workers share one cache of compiled programs; a file stays with one worker.
PYTEST_ARGS ?= -n 2 --dist loadfile

# A robotics shell often sets PYTHONPATH, and its packages would shadow the locked ones.
unexport PYTHONPATH
unexport PYTHONHOME
# The kernel of this environment wins over one in the home folder.
export JUPYTER_PREFER_ENV_PATH := 1

.PHONY: help venv demo lab test notebooks studies lint bench lock clean

help:
	@echo "make demo        create $(VENV) from environment.lock and design a better Go2, in minutes"
	@echo "make lab         create the same and open the notebooks in JupyterLab"
	@echo "make test        create the same, run the unit tests and every notebook at scale smoke"
	@echo "make venv        only create $(VENV)"
	@echo "make notebooks   execute and save all notebooks   (SCALE=smoke|reduced|full, NOTEBOOKS=...)"
	@echo "make studies     compute those results in data/results again whose agent is no longer shipped"
	@echo "make lint        check style with ruff"
	@echo "make bench       run the benchmarks"
	@echo "make lock        write environment.lock anew from pyproject.toml (needs uv)"
	@echo "make clean       remove $(VENV) and caches"
	@echo "PYTHON=/path/to/python3.12 chooses the interpreter (3.11, 3.12 or 3.13)"

# PYTHON reaches the script through the environment: no shell reads quotes or spaces in it. It looks
# each time, in half a second, as an interpreter or a package can be gone after an upgrade.
venv:
	@sh .ci/make_venv.sh $(VENV)

demo: venv
	$(PY) tools/demo.py

lab: venv
	$(PY) -m jupyterlab --ServerApp.root_dir=. --LabApp.default_url=/lab/tree/notebooks \
		$$(test "$$(id -u)" = 0 && echo --allow-root) $(LAB_ARGS)

# Both parts run even if the first one fails.
test: venv
	@status=0; \
	$(PY) -m pytest tests $(PYTEST_ARGS) || status=$$?; \
	if [ -n "$(NOTEBOOKS)" ]; then \
		SHAPEBODY_SCALE=smoke $(PY) -m pytest --nbmake --nbmake-timeout=900 -n 2 $(NOTEBOOKS) \
			|| status=$$?; \
	fi; \
	exit $$status

notebooks: venv
	SHAPEBODY_SCALE=$(SCALE) $(PY) -m tools.notebooks $(NOTEBOOKS)

studies: venv
	$(PY) -m tools.studies

lint: venv
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .

bench: venv
	@set -e; for file in benchmarks/*.py; do \
		if [ -e "$$file" ]; then echo "== $$file"; $(PY) "$$file"; fi; \
	done

lock:
	@sed -n '/^#/p' environment.lock > environment.lock.tmp
	@uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --extra dev \
		--no-header --no-annotate --no-emit-index-url --output-file environment.lock pyproject.toml
	@cat environment.lock >> environment.lock.tmp
	@mv environment.lock.tmp environment.lock

clean:
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
