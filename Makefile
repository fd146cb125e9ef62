# Two commands on a fresh machine with Python >= 3.11, a C compiler and make: `make demo` and `make test`.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
TORCH := $(shell sed -n 's/^torch==/torch==/p' constraints.txt)
PIP := $(BIN)/pip install --quiet --constraint constraints.txt
C_SOURCES := $(wildcard csrc/*.c csrc/*.h)
C_TESTS := $(patsubst csrc/tests/test_%.c,%,$(wildcard csrc/tests/test_*.c))
C_COMMON := csrc/dispatch.c csrc/parallel.c csrc/memory.c csrc/isa_base.c
C_FLAGS := -std=gnu11 -fno-math-errno -fno-trapping-math -Wall -Wextra -Wconversion -Wshadow -Wno-maybe-uninitialized -Werror -pthread
SANITIZE := -O1 -g -fsanitize=address,undefined,float-cast-overflow -fno-sanitize-recover=all
AVX2 := -mavx2 -mfma
AVX512 := -mavx512f -mavx512bw -mavx512dq -mavx512vl -mfma -mprefer-vector-width=512
X86 := $(filter x86_64,$(shell uname -m))

.PHONY: demo test check lint bench tools clean

demo: $(VENV)/installed
	$(BIN)/ast-sim demo

# The op tests run once more on each instruction set that is supported but was not chosen.
OTHER_SETS = from ast_sim.ops.library import configuration as c; print(*(i for i in c()["supported"] if i != c()["instruction_set"]))

test: $(VENV)/tested
	$(BIN)/python -m pytest
	@set -e; for isa in $$($(BIN)/python -c '$(OTHER_SETS)'); do \
	  echo "AST_SIM_ISA=$$isa"; AST_SIM_ISA=$$isa $(BIN)/python -m pytest tests/ops; \
	done

bench: $(VENV)/benched
	$(BIN)/python -m benchmarks.kernels --json benchmarks/results/kernels.json

lint: $(VENV)/tested
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/clang-format --dry-run --Werror csrc/*.c csrc/*.h csrc/tests/*.c csrc/tests/*.h

# The C tests, which need no Python: optimised, under the address and undefined behaviour sanitizers, and under valgrind.
# `wide` compiles the 64-byte source for AVX2, so that its logic is tested where there is no AVX-512.
check: $(addprefix build/check/,$(addsuffix .passed,$(C_TESTS)))

# torch first and by exact version: a range could fetch gigabytes of CUDA packages.
$(VENV)/torch: constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) $(TORCH)
	touch $@

$(VENV)/installed: $(VENV)/torch pyproject.toml setup.py MANIFEST.in $(C_SOURCES)
	$(PIP) --editable '.[simulate,view]'
	touch $@

$(VENV)/tested: $(VENV)/installed | tools
	$(PIP) --editable '.[simulate,view,test]'
	touch $@

$(VENV)/benched: $(VENV)/installed
	$(PIP) --editable '.[simulate,view,bench]'
	touch $@

# System programs that the tests use; installed where this is allowed, otherwise the tests say what is missing.
tools:
	@missing=; command -v chromium >/dev/null || missing="$$missing chromium"; command -v valgrind >/dev/null || missing="$$missing valgrind"; \
	if [ -n "$$missing" ]; then \
	  echo "installing$$missing"; \
	  (apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -qq -y $$missing >/dev/null) \
	    || echo "cannot install$$missing: the tests that need them will fail"; \
	fi

build/check/%.passed: csrc/tests/test_%.c $(wildcard csrc/tests/*.h) $(C_SOURCES) | tools
	@mkdir -p build/check
	@set -e; \
	build() { \
	  out=$$1; shift; objects=; \
	  if [ -n "$(X86)" ]; then \
	    $(CC) $(C_FLAGS) $$1 $(AVX2) -c csrc/isa_avx2.c -o $$out.avx2.o; \
	    $(CC) $(C_FLAGS) $$1 $(AVX512) -c csrc/isa_avx512.c -o $$out.avx512.o; \
	    objects="-DAST_HAVE_AVX2 -DAST_HAVE_AVX512 $$out.avx2.o $$out.avx512.o"; \
	  fi; \
	  $(CC) $(C_FLAGS) $$1 $$2 $(C_COMMON) $< $$objects -lm -o $$out; \
	}; \
	name=build/check/$*; \
	build $$name "-O3"; echo "$*"; ./$$name; \
	build $$name-sanitized "$(SANITIZE)"; echo "$* (sanitizers)"; ASAN_OPTIONS=detect_leaks=1 ./$$name-sanitized; \
	if [ -n "$(X86)" ]; then \
	  $(CC) $(C_FLAGS) -Wno-psabi -O2 $(AVX2) -DAST_VECTOR_BYTES=64 $(C_COMMON) $< -lm -o $$name-wide; \
	  echo "$* (64 byte vectors on AVX2)"; ./$$name-wide; \
	fi; \
	build $$name-valgrind "-O1 -g"; echo "$* (valgrind)"; \
	AST_TEST_QUICK=1 valgrind --quiet --error-exitcode=1 --leak-check=full ./$$name-valgrind
	@touch $@

clean:
	rm -rf build dist *.egg-info ast_sim/*.so
