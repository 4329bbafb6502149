# `make demo` fits a portrait; `make docs` builds the site; `make check` runs lint, types and laws, `make modes` laws in JAX's
# other modes, `make test` everything. All start from
# nothing but Python 3.11+ and make.

PYTHON ?= python3
BIN := .venv/bin
PORTRAIT = $(shell $(BIN)/python -c "import matplotlib.cbook as c; print(c.get_sample_data('grace_hopper.jpg', asfileobj=False))")

.PHONY: demo docs lint check modes test clean

demo: .venv/plots
	$(BIN)/jaxfit fit "$(PORTRAIT)" --out demo
	@echo "Look at demo/overlays/grace_hopper.jpg"

docs: .venv/docs
	$(BIN)/sphinx-build --fail-on-warning --quiet docs build/site
	@echo "Open build/site/index.html"

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Not what starts processes, a browser or a notebook, or takes long.
check: lint
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow"

# The laws again, with float64 at hand and with types that must not be mixed, as programs around this package may set.
modes: .venv/dev
	JAX_ENABLE_X64=1 $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow"
	JAX_NUMPY_DTYPE_PROMOTION=strict $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow"

test: lint
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# One stamp for each set of extras; the pinned versions make the result reproducible.
.venv/%: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[$*]"
	touch $@

clean:
	rm -rf .venv demo build *.egg-info .mypy_cache .ruff_cache .pytest_cache
