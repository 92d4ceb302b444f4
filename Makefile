# Two commands run everything: make reproduce, make test. Both build .venv first where it is missing or out of date.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.NOTPARALLEL:

# --- what you may set --------------------------------------------------------------------------------------------
# The first Python 3.11 that starts.
PYTHON ?= $(shell for p in python3.11 python3 python; do \
	"$$p" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null && { echo "$$p"; break; }; done)
# PyTorch's index of CPU wheels, as its install page gives it; needed where pip cannot find the CPU wheel by itself.
TORCH_INDEX ?=
# CUDA=1 installs torch with CUDA instead of the CPU build.
CUDA ?=
# make figures, paper, data-sample, weights: of which preset.
PRESET ?= paper
# make test: in so many processes at once, by default one more than cores, four at most; each computes in one thread.
JOBS ?= $(shell n=$$(nproc 2>/dev/null || echo 2); echo $$(( n < 4 ? n + 1 : 4 )))
# make lock: the uv program, and a folder that holds torch's CPU wheel.
UV ?= uv
FIND_LINKS ?=

# --- the environment of every run --------------------------------------------------------------------------------
# Modules are compiled once, not by each of the hundred processes of a run.
unexport PYTHONDONTWRITEBYTECODE
# Keep freed memory instead of handing it back to the system after each step: about 10 % of training time (glibc).
export MALLOC_MMAP_THRESHOLD_ ?= 4294967296
export MALLOC_TRIM_THRESHOLD_ ?= 8589934592

TORCH := 2.13.0
# Later releases build a grammar of addresses at every import, 3 s in each process that opens a notebook.
JSONSCHEMA := jsonschema<4.25
PY := .venv/bin/python
PIP := $(PY) -m pip --disable-pip-version-check install --quiet --only-binary :all:
STAMP := .venv/.installed
SITE := .venv/docs
PYTEST := OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(PY) -m pytest --numprocesses $(JOBS) --dist loadfile --no-loadscope-reorder
# run_all would run every notebook a second time: a test in tests/ runs it through papermill.
NOTEBOOKS := $(wildcard notebooks/[01]*.ipynb) notebooks/explore.ipynb $(wildcard notebooks/your_*.ipynb)
NBVAL := --nbval --nbval-current-env --nbval-cell-timeout=600 --nbval-sanitize-with=tests/nbval_sanitize.cfg
# What differs from machine to machine is left out: the time of each cell, and the versions of Python and of tools.
NBCONVERT := $(PY) -m jupyter nbconvert --to notebook --execute --inplace --log-level=ERROR \
	--ExecutePreprocessor.record_timing=False --ClearMetadataPreprocessor.enabled=True \
	--ClearMetadataPreprocessor.clear_cell_metadata=False \
	"--ClearMetadataPreprocessor.preserve_nb_metadata_mask={'kernelspec', ('language_info', 'name')}"
PAPERMILL := $(PY) -m papermill --kernel python3

.PHONY: help .venv reproduce smoke test lint unit notebooks-test notebooks-store figures paper readme docs weights \
	data-sample lab lock docs-lock clean clean-all force

help: ## List the targets
	@grep -hE '^[.a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | awk -F'\t' '{ printf "  make %-15s %s\n", $$1, $$2 }'

reproduce: $(STAMP) ## Run the whole experiment, preset quick: render, train, evaluate, draw
	$(PY) -m mmgsd reproduce quick

smoke: $(STAMP) ## The same with the preset smoke: every stage, tiny
	$(PY) -m mmgsd reproduce smoke

test: lint ## Every check: lint, and in one run what unit and notebooks-test run
	$(PYTEST) tests $(NBVAL) $(NOTEBOOKS)

lint: $(STAMP) ## Check the style with ruff
	$(PY) -m ruff check .

unit: $(STAMP) ## Run the tests in tests/
	$(PYTEST) tests

notebooks-test: $(STAMP) ## Run the notebooks and compare their outputs with the committed ones
	$(PYTEST) $(NBVAL) $(NOTEBOOKS)

notebooks-store: $(STAMP) ## Run the notebooks and store their outputs, after results changed
	$(NBCONVERT) $(NOTEBOOKS)

figures: $(STAMP) ## Draw the paper's figures of PRESET (paper) again from data/results, without training
	@mkdir -p data/generated
	$(PAPERMILL) notebooks/07_figures.ipynb data/generated/figures_$(PRESET).ipynb -p preset $(PRESET) -p run True

readme: $(STAMP) ## Put the numbers of data/results into README.md, the results page and docs/claims.md; make docs/api.md
	$(PY) -m mmgsd tables data/results README.md data/results/README.md data/results/shipped.md docs/claims.md
	$(PY) -m mmgsd interface docs/api.md

# Its tools are no part of the environment: only who builds the site needs them.
docs: $(STAMP) ## Build the pages and the reference as a site in data/generated/docs; a dead link fails
	@[ "$$(cat $(SITE)/.lock 2>/dev/null)" = "$$(sha256sum docs/requirements.lock)" ] || { rm -rf $(SITE) && \
		$(PIP) --require-hashes --no-deps --target $(SITE) -r docs/requirements.lock && \
		sha256sum docs/requirements.lock > $(SITE)/.lock; }
	PYTHONPATH=$(SITE) $(PY) -m sphinx -W --keep-going --quiet -c docs . data/generated/docs
	@echo "data/generated/docs/index.html"

data-sample: $(STAMP) ## Copy 24 images of each object of PRESET into data/sample
	$(PY) -m mmgsd write-sample $(PRESET)

weights: $(STAMP) ## Put the models of PRESET into data/weights, in half precision and with a card each
	$(PY) -m mmgsd ship $(PRESET)

# Not committed: numbers, tables and verdicts are made anew from data/results/PRESET.
paper: $(STAMP) ## Make the replication report paper/report.pdf from the results of PRESET; needs LaTeX
	@command -v latexmk > /dev/null || { \
		echo "make paper needs latexmk and LaTeX: on Debian, apt-get install latexmk texlive-latex-base texlive-latex-extra" \
			"texlive-publishers texlive-science texlive-fonts-recommended." >&2; exit 1; }
	$(PY) -m mmgsd latex $(PRESET)
	cd paper && latexmk -pdf -interaction=nonstopmode -halt-on-error report.tex

lab: $(STAMP) ## Open the notebooks in JupyterLab
	$(PY) -m jupyterlab notebooks

# --- installation ------------------------------------------------------------------------------------------------
.venv: $(STAMP) ## Make the virtual environment from environment.lock (CUDA=1: torch with CUDA)

# The stamp, written last, says which torch is installed and from which environment.lock, by its content: a checkout
# changes the file's date. A CPU environment is made anew where CUDA is asked for; a CUDA environment stays one.
LOCKED := $(shell sha256sum environment.lock 2>/dev/null | cut -c-64)
ifeq ($(filter $(if $(filter 1,$(CUDA)),,cpu-$(LOCKED)) cuda-$(LOCKED),$(shell cat $(STAMP) 2>/dev/null)),)
$(STAMP): force
endif

# torch comes before the rest, for it is the one package that pip may need an extra index for: what follows finds it
# installed, and its absence is told in a second instead of after all other downloads. The .pth file makes
# the folder mmgsd importable as it stands.
$(STAMP): | environment.lock
	@[ ! -L .venv ] || { \
		echo ".venv is a link to $$(readlink .venv), which was not made from this environment.lock and would be emptied:" \
			"remove the link (rm .venv) to have an environment made here, or run make there." >&2; exit 1; }
	@[ -n "$(PYTHON)" ] && "$(PYTHON)" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null || { \
		echo "mmgsd needs Python 3.11, the only version its Blender module is built for:" \
			"install it, or name it with PYTHON=/path/to/python3.11." >&2; exit 1; }
	@echo "Making .venv from environment.lock: two minutes or more, 3 GB on disk"
	@rm -f $@
	"$(PYTHON)" -m venv --clear .venv
	@awk '/^torch==/ { on = 1; print; next } /^[^ #]/ { on = 0 } on' environment.lock > .venv/torch.lock
	@awk '/^torch==/ { on = 1; next } /^[^ #]/ { on = 0 } !on' environment.lock > .venv/rest.lock
ifeq ($(CUDA),1)
	$(PIP) --require-hashes --no-deps -r .venv/rest.lock
	$(PIP) $(if $(TORCH_INDEX),--extra-index-url "$(TORCH_INDEX)") "torch==$(TORCH),!=$(TORCH)+cpu"
else
	@$(PIP) --require-hashes --no-deps $(if $(TORCH_INDEX),--extra-index-url "$(TORCH_INDEX)") -r .venv/torch.lock || { \
		echo "torch's CPU build could not be installed. If pip found no version $(TORCH)+cpu above, run the command" \
			"again with TORCH_INDEX=... set to PyTorch's index of CPU wheels, the address that the install page" \
			"of PyTorch gives for 'CPU'; for the CUDA build set CUDA=1 instead." >&2; exit 1; }
	$(PIP) --require-hashes --no-deps -r environment.lock
endif
	@pwd > "$$($(PY) -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/mmgsd.pth"
	@echo $(if $(filter 1,$(CUDA)),cuda,cpu)-$(LOCKED) > $@.new
	@mv $@.new $@

lock: ## Make environment.lock from pyproject.toml (UV=uv, FIND_LINKS=folder with torch's CPU wheel)
	@{ echo "# Every package of the project, pinned and hashed, for Python 3.11 on Linux x86-64. Made from pyproject.toml by"; \
		echo "#    make lock FIND_LINKS=<a folder with the wheel of torch $(TORCH)+cpu>"; \
		echo "# which keeps the pins it finds here; delete this file first to move all of them on."; } > environment.head
	@[ ! -f environment.lock ] || cp environment.lock environment.new
	printf '%s\n' "torch==$(TORCH)+cpu" "$(JSONSCHEMA)" | $(UV) pip compile --quiet --python-version 3.11 --generate-hashes \
		--no-header --all-extras $(if $(FIND_LINKS),--find-links "$(FIND_LINKS)") --annotation-style line \
		--output-file environment.new pyproject.toml -
	@sed -i -E 's/-r -(, |$$)//; s/, $$//' environment.new
	cat environment.head environment.new > environment.lock
	@rm environment.head environment.new

docs-lock: ## Make docs/requirements.lock from docs/requirements.in, with the pins of environment.lock (UV=uv)
	@grep -oE '^[A-Za-z0-9_.-]+==[^ ]+' environment.lock | grep -v '^torch==' > docs/constraints.new
	$(UV) pip compile --quiet --python-version 3.11 --generate-hashes --no-header --annotation-style line \
		--constraint docs/constraints.new --output-file docs/requirements.lock docs/requirements.in
	@sed -i -E 's/-c [^,]*(, |$$)//; s/, $$//' docs/requirements.lock
	@rm docs/constraints.new

# --- cleaning ----------------------------------------------------------------------------------------------------
clean: ## Remove caches and what the preset smoke made
	rm -rf .pytest_cache .ruff_cache .hypothesis build dist mmgsd.egg-info data/generated/smoke data/results/smoke figures/smoke
	rm -f data/generated/run_all_smoke.ipynb figures/data/smoke_*
	find . -path ./.venv -prune -o \( -name __pycache__ -o -name .ipynb_checkpoints \) -type d -exec rm -rf {} +

clean-all: clean ## Remove also .venv and everything generated: renders and trained models
	rm -rf .venv data/generated
