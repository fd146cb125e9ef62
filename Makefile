# Two commands on a fresh machine with Python >= 3.11, a C compiler and make: `make demo` and `make test`.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
TORCH := $(shell sed -n 's/^torch==/torch==/p' constraints.txt)
# Python keeps what it has compiled, or each of some hundred processes would compile the package once more (0.3 s). It does so for what is
# imported; pip would do it for all of 14,500 files.
unexport PYTHONDONTWRITEBYTECODE
PIP := $(BIN)/pip install --quiet --no-compile --constraint constraints.txt
C_SOURCES := $(wildcard csrc/*.c csrc/*.h csrc/tests/simd_*.h)
C_TESTS := $(patsubst csrc/tests/test_%.c,%,$(wildcard csrc/tests/test_*.c))
SLOW_FIRST := $(filter attention linear message fps,$(C_TESTS)) $(filter-out attention linear message fps,$(C_TESTS))
C_FUZZERS := $(patsubst csrc/tests/fuzz_%.c,%,$(wildcard csrc/tests/fuzz_*.c))
C_TEST_HEADERS := $(wildcard csrc/tests/*.h)
X86 := $(filter x86_64,$(shell uname -m))

.PHONY: demo test check fuzz corpus lint docs bench shipped tools install-tools clean

demo: $(VENV)/installed
	$(BIN)/ast-sim demo

# The op tests run once more on each instruction set that is supported but was not chosen, except those that run on all by themselves, and
# those that no kernel has a part in: how ops are registered (opcheck) and differentiated, how the library is found and told of threads, and
# which arguments it takes (what odd values do to a kernel of any set the fuzz targets try). Each set has a process, gw0, gw1 and so on, which
# runs all of them.
OTHER_SETS = from ast_sim.ops.library import configuration as c; \
	print(*(f"--tx=popen//env:AST_SIM_ISA={i}" for i in c()["supported"] if i != c()["instruction_set"]))

# Side by side, of a file in any order; more than four processes could want more memory than there is.
PYTEST := $(BIN)/python -m pytest --numprocesses=auto --maxprocesses=4 --dist=worksteal

test: $(VENV)/tested
	$(PYTEST)
	@set -e; sets="$$($(BIN)/python -c '$(OTHER_SETS)')"; if [ -n "$$sets" ]; then \
	  echo "$$sets"; $(BIN)/python -m pytest $$sets --dist=each tests/ops -k "not every_instruction_set and not opcheck" \
	      $(patsubst %,--ignore=tests/ops/test_%.py,library derivatives binding_arguments trusted_indices spec); \
	fi

bench: $(VENV)/benched
	$(BIN)/python -m benchmarks.kernels --json benchmarks/results/kernels.json

# The runs that come with the package, from nothing: some hours. CalculiX must be installed.
shipped: $(VENV)/tested
	$(BIN)/python -m benchmarks.studies.shipped

# `make check` compiles all of the core but its Python module, which needs the headers of Python and numpy.
INCLUDE := import numpy, sysconfig; print('-isystem', numpy.get_include(), '-isystem', sysconfig.get_path('include'))
lint: $(VENV)/tested
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/python tests/test_house.py
	$(BIN)/basedpyright --pythonpath $(BIN)/python
	$(BIN)/clang-format --dry-run --Werror csrc/*.c csrc/*.h csrc/tests/*.c csrc/tests/*.h
	@set -e; include=$$($(BIN)/python -c "$(INCLUDE)"); for compiler in gcc-11 clang; do \
	  echo "$$compiler: csrc/module.c"; $$compiler -std=gnu11 -fsyntax-only $(WARNINGS) $$include csrc/module.c; \
	done

# The pages of the reference, from docstrings and the help of the commands.
docs: $(VENV)/installed
	$(BIN)/python docs/make_reference.py

BUILDS := sanitized uninitialised races $(if $(X86),aarch64 wide) plain gcc11 clang
CHECKS := $(foreach build,$(BUILDS),$(patsubst %,build/check/$(build)/%.passed,$(SLOW_FIRST))) \
  build/check/undefined/no_memory.passed $(addprefix build/check/fuzz_,$(addsuffix .passed,$(C_FUZZERS)))

# The C tests, which need no Python: optimised, under the address and undefined behaviour sanitizers, under the thread sanitizer,
# under the memory sanitizer (what is read before it is written), and as GCC 11, clang and GCC for aarch64 (on an emulator) compile them. What happens
# where memory is lacking runs under clang's undefined behaviour sanitizer, too. `wide` compiles the 64-byte source for AVX2, so
# that its logic is tested where there is no AVX-512. The kept inputs of the fuzz targets run once more.
# Each test of each build is a target of its own, those that take longest first, so that with `--jobs` no core is left idle in the end.
check: $(CHECKS)

# New inputs for each fuzz target for FUZZ_SECONDS; what it finds lies in build/fuzz. FUZZ names fewer targets.
FUZZ_SECONDS ?= 600
FUZZ ?= $(C_FUZZERS)
fuzz: $(addprefix build/check/fuzz/fuzz_,$(FUZZ))
	@set -e; for name in $(FUZZ); do \
	  mkdir -p build/fuzz/$$name csrc/tests/corpus/$$name; \
	  echo "$$name for $(FUZZ_SECONDS) s"; \
	  build/check/fuzz/fuzz_$$name -max_total_time=$(FUZZ_SECONDS) -max_len=200 -len_control=0 -verbosity=0 -print_funcs=0 -print_final_stats=1 \
	    -artifact_prefix=build/fuzz/$$name- build/fuzz/$$name csrc/tests/corpus/$$name; \
	done

# Keeps the smallest of all inputs so far that run every piece of code that they all run.
corpus: $(addprefix build/check/fuzz/fuzz_,$(FUZZ))
	@set -e; for name in $(FUZZ); do \
	  rm -rf build/fuzz/merged; mkdir -p build/fuzz/$$name build/fuzz/merged csrc/tests/corpus/$$name; \
	  build/check/fuzz/fuzz_$$name -set_cover_merge=1 -use_counters=0 -artifact_prefix=build/fuzz/$$name- build/fuzz/merged \
	    csrc/tests/corpus/$$name build/fuzz/$$name 2>/dev/null; \
	  rm -rf csrc/tests/corpus/$$name; mv build/fuzz/merged csrc/tests/corpus/$$name; \
	  echo "$$name: $$(ls csrc/tests/corpus/$$name | wc -l) inputs"; \
	done

# torch first and by exact version: a range could fetch gigabytes of CUDA packages.
$(VENV)/torch: constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) $(TORCH)
	touch $@

$(VENV)/installed: $(VENV)/torch pyproject.toml setup.py MANIFEST.in $(C_SOURCES)
	$(PIP) --editable '.[simulate,cad,read,view]'
	touch $@

# By name, the package that is there gets its extras; by path, it would be built once more, half a minute on one core.
$(VENV)/tested: $(VENV)/installed | tools
	$(PIP) 'ast_sim[simulate,cad,cluster,read,tfrecord,view,test]'
	touch $@

$(VENV)/benched: $(VENV)/installed
	$(PIP) --editable '.[simulate,cad,read,tfrecord,view,bench]'
	touch $@

# System programs that the tests use: what is missing, and how to get it. Nothing is installed but by `make install-tools`; then one at a time if
# not all together: a system that does not know one of them still gets the others.
COMMANDS := chromium clang gcc-11 $(if $(X86),aarch64-linux-gnu-gcc:gcc-aarch64-linux-gnu qemu-aarch64:qemu-user) ccx:calculix-ccx
FIND_MISSING := missing=; for tool in $(COMMANDS); do command -v $${tool%:*} >/dev/null || missing="$$missing $${tool\#*:}"; done; \
	ldconfig -p | grep -q libGLU.so.1 || missing="$$missing libglu1-mesa libxft2 libxcursor1 libxinerama1 libxrender1 libxfixes3"; \
	ls $$(clang -print-resource-dir 2>/dev/null)/lib/linux/*fuzzer* >/dev/null 2>&1 || missing="$$missing libclang-rt-14-dev"; \
	ls /usr/aarch64-linux-gnu/lib/libc.so.6 >/dev/null 2>&1 || missing="$$missing $(if $(X86),libc6-dev-arm64-cross)"
tools:
	@$(FIND_MISSING); if [ -n "$$missing" ]; then \
	  echo "missing:$$missing"; \
	  echo "the tests that need them will fail; \`make install-tools\` as root gets them: apt-get install$$missing"; \
	fi
install-tools:
	@$(FIND_MISSING); if [ -n "$$missing" ]; then \
	  echo "installing$$missing"; export DEBIAN_FRONTEND=noninteractive; install="apt-get install -qq -y"; \
	  apt-get update -qq; $$install $$missing >/dev/null 2>&1 || for package in $$missing; do \
	    $$install $$package >/dev/null || echo "cannot install $$package: the tests that need it will fail"; \
	  done; \
	fi

# ---- the builds of the C tests ----

C_FLAGS := -std=gnu11 -fno-math-errno -fno-trapping-math -pthread
SANITIZE := address,undefined,float-cast-overflow
WARNINGS := -Wall -Wextra -Wconversion -Wshadow -Wno-psabi -Werror
GCC_WARNINGS := $(WARNINGS) -Wno-maybe-uninitialized
GCC := $(CC) $(C_FLAGS) $(GCC_WARNINGS)
CLANG := clang $(C_FLAGS) -w
# What users compile, with all warnings.
COMPILE_plain := $(CC) $(C_FLAGS) $(WARNINGS) -O3
# GCC fuses products and sums into one operation from -O2 on; AST_UNFUSED tells the test of rounding errors where it does not.
# -O0 would save 50 s of compiling the sanitized kernels and cost 80 s of running them. -g1 has lines but no variables, whose places
# took GCC two fifths of its time, and clang a quarter.
COMPILE_sanitized := $(GCC) -O1 -g1 -DAST_UNFUSED -fsanitize=$(SANITIZE) -fno-sanitize-recover=all
COMPILE_races := $(CLANG) -O1 -g1 -DAST_UNFUSED -fsanitize=thread
COMPILE_uninitialised := $(CLANG) -O1 -g1 -DAST_UNFUSED -fsanitize=memory -fno-sanitize-recover=all
# For `no_memory` alone: clang, not GCC, sees a pointer that is formed from memory that could not be had.
COMPILE_undefined := $(CLANG) -O0 -g1 -DAST_UNFUSED -fsanitize=undefined -fno-sanitize-recover=all
# -O0: the optimiser takes minutes over unrolled products with all these checks in them. Comparisons are not traced, nor branches of the
# targets themselves: the sizes that a kernel compares do not stand in an input, and the tracing took most of the time.
COMPILE_fuzz := $(CLANG) -O0 -g1 -fsanitize=fuzzer-no-link,$(SANITIZE) -fno-sanitize-coverage=trace-cmp -fno-sanitize-recover=all
COMPILE_target := $(CLANG) -O1 -g1 -fsanitize=$(SANITIZE) -fno-sanitize-recover=all
# -O1: 13 s, and -O2 35 s. The code that is compiled so is not the library's.
COMPILE_wide := $(GCC) -O1 -DAST_UNFUSED -mavx2 -mfma -DAST_VECTOR_BYTES=64
COMPILE_gcc11 := gcc-11 $(C_FLAGS) $(GCC_WARNINGS) -O2
COMPILE_clang := clang $(C_FLAGS) $(WARNINGS) -O2 -DAST_UNFUSED
COMPILE_aarch64 := aarch64-linux-gnu-gcc $(C_FLAGS) $(GCC_WARNINGS) -O2

KERNELS := isa_base dispatch parallel memory status
CORE := $(KERNELS) tests/simd_base tests/bfloat16_base
ifneq ($(X86),)
CORE_X86 := isa_avx2 isa_avx512
# What differs in them no sanitizer sees: tiles read and write behind the compiler's back.
CORE_bfloat16 := isa_avx512_bf16 isa_amx
SIMD_X86 := tests/simd_avx2 tests/simd_avx512
FLAGS_isa_avx2 := -mavx2 -mfma
FLAGS_isa_avx512 := -mavx512f -mavx512bw -mavx512dq -mavx512vl -mfma -mprefer-vector-width=512
FLAGS_isa_avx512_bf16 := $(FLAGS_isa_avx512) -mavx512bf16
FLAGS_isa_amx := $(FLAGS_isa_avx512_bf16) -mamx-tile -mamx-bf16
FLAGS_tests/simd_avx2 := $(FLAGS_isa_avx2)
FLAGS_tests/simd_avx512 := $(FLAGS_isa_avx512)
FLAGS_dispatch := -DAST_HAVE_AVX2 -DAST_HAVE_AVX512
endif
# Every allocation of this test passes through functions of its own.
LINK_test_no_memory := -Wl,--wrap=malloc,--wrap=calloc,--wrap=realloc,--wrap=aligned_alloc,--wrap=posix_memalign,--wrap=free

# build/check/BUILD: the core as a library, and a program for each test.
define BUILD
build/check/$(1)/%.o: csrc/%.c $(C_SOURCES) | tools
	@mkdir -p $$(@D)
	@$(COMPILE_$(1)) $$(FLAGS_$$*) -c $$< -o $$@
build/check/$(1)/core.a: $(patsubst %,build/check/$(1)/%.o,$(if $(filter undefined,$(1)),$(KERNELS),$(CORE) $(if $(filter wide aarch64,$(1)),,$(CORE_X86)) $(if $(filter plain gcc11 clang,$(1)),$(CORE_bfloat16)) $(if $(filter aarch64,$(1)),,$(SIMD_X86))))
	@ar rcs $$@ $$^
$(patsubst %,build/check/$(1)/test_%,$(C_TESTS)): build/check/$(1)/test_%: csrc/tests/test_%.c $(C_TEST_HEADERS) build/check/$(1)/core.a
	@$(COMPILE_$(1)) $$< build/check/$(1)/core.a -lm $$(LINK_test_$$*) -o $$@
endef
$(foreach build,$(BUILDS) undefined fuzz,$(eval $(call BUILD,$(build))))
build/check/wide/%.o build/check/aarch64/%.o build/check/undefined/%.o: FLAGS_dispatch :=
build/check/plain/%.o build/check/gcc11/%.o build/check/clang/%.o: FLAGS_dispatch += $(if $(X86),-DAST_HAVE_AVX512_BF16 -DAST_HAVE_AMX)

$(addprefix build/check/fuzz/fuzz_,$(C_FUZZERS)): build/check/fuzz/fuzz_%: csrc/tests/fuzz_%.c csrc/tests/test_%.c $(C_TEST_HEADERS) build/check/fuzz/core.a
	@$(COMPILE_target) -c $< -o $@.o
	@$(COMPILE_target) -fsanitize=fuzzer $@.o build/check/fuzz/core.a -lm -o $@

build/check/fuzz_%.passed: build/check/fuzz/fuzz_% csrc/tests/corpus/%
	@echo "$* (kept inputs of its fuzz target)"
	@mkdir -p build/fuzz
	@$< -runs=0 -verbosity=0 -artifact_prefix=build/fuzz/$*- csrc/tests/corpus/$*
	@touch $@

# The thread sanitizer finds no room for its shadow memory where addresses are too random.
RUN_sanitized := env ASAN_OPTIONS=detect_leaks=1
RUN_races = env AST_TEST_QUICK=1 $$(setarch -R true 2>/dev/null && echo setarch -R)
RUN_uninitialised := env AST_TEST_QUICK=1
RUN_gcc11 := env AST_TEST_QUICK=1
RUN_clang := env AST_TEST_QUICK=1
RUN_undefined := env AST_TEST_QUICK=1
RUN_aarch64 := env AST_TEST_QUICK=1 qemu-aarch64 -L /usr/aarch64-linux-gnu
NAME_plain := optimised
NAME_sanitized := address and undefined behaviour sanitizers
NAME_races := thread sanitizer
NAME_uninitialised := memory sanitizer
NAME_gcc11 := GCC 11
NAME_clang := clang
NAME_undefined := clang, undefined behaviour sanitizer
NAME_wide := 64 byte vectors on AVX2
NAME_aarch64 := aarch64

define RUN
$(patsubst %,build/check/$(1)/%.passed,$(C_TESTS)): build/check/$(1)/%.passed: build/check/$(1)/test_%
	@echo "$$* ($(NAME_$(1)))"
	@$$(RUN_$(1)) $$<
	@touch $$@
endef
$(foreach build,$(BUILDS) undefined,$(eval $(call RUN,$(build))))

# Where each request for scratch memory is an allocation of its own, as under this sanitizer, every way to fail takes three minutes.
build/check/sanitized/no_memory.passed: RUN_sanitized += AST_TEST_QUICK=1

clean:
	rm -rf build dist *.egg-info ast_sim/*.so
