"""Builds ast_sim._C: the kernels as one static library per instruction set, and a stable-ABI extension over them."""

import platform
import tempfile
from pathlib import Path

import numpy
from setuptools import Extension, setup
from setuptools._distutils.ccompiler import new_compiler
from setuptools._distutils.sysconfig import customize_compiler
from setuptools.errors import CompileError

FLAGS = [
    "-std=gnu11",
    "-O3",
    "-g1",  # Python's own flags have -g: the places of variables are two fifths of the time and most of the file
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fvisibility=hidden",
    "-Wall",
    "-Wextra",
    "-Wno-unknown-pragmas",
    "-Wno-psabi",
]
AVX512 = [
    "-mavx512f",
    "-mavx512bw",
    "-mavx512dq",
    "-mavx512vl",
    "-mfma",
    "-ffp-contract=fast",
    "-mprefer-vector-width=512",
]
INSTRUCTION_SETS = {
    "base": [],
    "avx2": ["-mavx2", "-mfma", "-ffp-contract=fast"],
    "avx512": AVX512,
    "avx512_bf16": [*AVX512, "-mavx512bf16"],
    "amx": [*AVX512, "-mavx512bf16", "-mamx-tile", "-mamx-bf16"],
}
HEADERS = [str(path) for path in sorted(Path("csrc").glob("*.h"))]
SOURCES = [str(path) for path in sorted(Path("csrc").glob("*.c"))]


def compiles(flags: list[str]) -> bool:
    """Whether the compiler takes these flags."""
    compiler = new_compiler()
    customize_compiler(compiler)
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "probe.c"
        source.write_text("int probe(void) { return 0; }\n")
        try:
            compiler.compile([str(source)], output_dir=folder, extra_postargs=flags)
        except CompileError:
            return False
    return True


x86 = platform.machine().lower() in ("x86_64", "amd64")
sets = {isa: flags for isa, flags in INSTRUCTION_SETS.items() if isa == "base" or (x86 and compiles(flags))}
libraries = [
    (
        f"ast_{isa}",
        {
            "sources": [f"csrc/isa_{isa}.c"],
            "cflags": FLAGS + flags,
            "obj_deps": {"": HEADERS + SOURCES},
        },
    )
    for isa, flags in sets.items()
]
extension = Extension(
    "ast_sim._C",
    sources=["csrc/module.c", "csrc/dispatch.c", "csrc/parallel.c", "csrc/memory.c", "csrc/status.c"],
    depends=HEADERS + SOURCES,
    include_dirs=[numpy.get_include()],
    define_macros=[(f"AST_HAVE_{isa.upper()}", None) for isa in sets],
    extra_compile_args=FLAGS,
    py_limited_api=True,
)
setup(libraries=libraries, ext_modules=[extension], options={"bdist_wheel": {"py_limited_api": "cp311"}})
