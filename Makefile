# `make demo` fits a portrait; `make docs` builds the site. `make check` runs lint, types and laws, `make test` most tests,
# `make everything` all of them; `make modes` runs the laws in JAX's other modes; `make release` makes both packages and
# tries them. All start from nothing but Python 3.11+ and make.

PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo docs lint check modes test everything release clean

demo: .venv/plain
	$(BIN)/jaxfit demo

docs: .venv/docs
	$(BIN)/sphinx-build --fail-on-warning --quiet docs build/site
	@echo "Open build/site/index.html"

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

TEST := $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# Not what starts processes, a browser or a notebook, or takes long.
check: lint
	$(TEST) -m "not slow"

# The laws again, with float64 at hand and with types that must not be mixed, as programs around this package may set.
modes: .venv/dev
	JAX_ENABLE_X64=1 $(TEST) -m "not slow"
	JAX_NUMPY_DTYPE_PROMOTION=strict $(TEST) -m "not slow"

# Not the commands of the documents, notebooks, and what trains or exports many models.
test: lint
	$(TEST) -m "not long"

everything: lint
	$(TEST)

# All tests, the site, and both packages, of which the wheel is tried in an empty environment of each Python:
# make release PYTHONS="python3.11 python3.12 python3.13"
PYTHONS ?= $(PYTHON)

release: everything docs
	rm -rf dist
	$(BIN)/python scripts/installing.py --python $(PYTHONS)

# One stamp for each set of extras, and one for none; the pinned versions make the result reproducible.
.venv/%: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".$(patsubst %,[%],$(filter-out plain,$*))"
	touch $@

clean:
	rm -rf .venv demo build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache
