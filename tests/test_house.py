"""The package stays tidy: short modules and functions, small folders, names that mean one thing.

`python tests/test_house.py` prints the lines of code of each room; `make lint` does so.
"""

import ast
import io
import re
import tokenize
from collections import Counter
from importlib.util import find_spec
from pathlib import Path

import pytest

from ast_sim.importers.formats.vtk_files import READING_MODULE
from ast_sim.simulate.families.known_families import FAMILIES, MODULES
from ast_sim.simulate.jobs.fastest_solver import SOLVER_MODULE
from ast_sim.simulate.jobs.pool import WORKER_MODULE
from ast_sim.simulate.shapes.cad.gmsh_process import MESHING_MODULE

REPOSITORY = Path(__file__).parent.parent
ROOT = REPOSITORY / "ast_sim"
MODULE_FILES = sorted(ROOT.rglob("*.py"))
BENCHMARKS = sorted((REPOSITORY / "benchmarks").rglob("*.py"))
FOLDERS = sorted({path.parent for path in MODULE_FILES})

MOST_MODULE_LINES = 350
MOST_FUNCTION_LINES = 60
FILES_OF_A_FOLDER = range(3, 16)  # sub-packages count where a folder holds no module

_NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def code_lines(source: str) -> int:
    """The lines that hold code: not blank, no comment, no docstring."""
    documented: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and ast.get_docstring(
            node
        ):
            documented.update(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    used: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _NO_CODE:
            used.update(range(token.start[0], token.end[0] + 1))
    return len(used - documented)


def long_functions(source: str, most: int) -> dict[str, int]:
    """The functions with more lines than that, by name; decorators do not count, docstrings do."""
    functions = (n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef))
    lines = {function.name: function.end_lineno - function.lineno + 1 for function in functions}
    return {name: count for name, count in lines.items() if count > most}


def test_the_counters_count():
    source = '"""Two\nlines."""\n\n# a comment\ndef f(x):\n    """One."""\n    return [  # why\n        x,\n    ]\n'
    assert code_lines(source) == 4
    assert long_functions(source, 4) == {"f": 5} and not long_functions(source, 5)


@pytest.mark.parametrize("path", MODULE_FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_modules_and_functions_are_short(path):
    source = path.read_text(encoding="utf-8")
    assert len(source.splitlines()) <= MOST_MODULE_LINES
    assert not long_functions(source, MOST_FUNCTION_LINES)


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.relative_to(ROOT.parent).as_posix())
def test_folders_hold_a_few_files(folder):
    modules = list(folder.glob("*.py"))
    if [path.name for path in modules] == ["__init__.py"]:
        modules += [inner for inner in FOLDERS if inner.parent == folder]
    assert len(modules) in FILES_OF_A_FOLDER, sorted(path.name for path in modules)


def test_a_name_means_one_thing():
    """Modules and sub-packages share one set of names."""
    names = Counter(path.stem for path in MODULE_FILES if path.name != "__init__.py")
    names.update(folder.name for folder in FOLDERS)
    assert not [name for name, count in names.items() if count > 1]


def kinds(source: str) -> list[str]:
    """The names of public classes, and of types that are made of others, such as `Json = dict[str, Any]`."""
    tree = ast.parse(source)
    names = [node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    assigned = (target for node in tree.body if isinstance(node, ast.Assign) for target in node.targets)
    names += [target.id for target in assigned if isinstance(target, ast.Name)]
    return [name for name in names if re.fullmatch(r"[A-Z]\w*[a-z]\w*", name)]


def test_a_class_has_a_name_of_its_own():
    """A reader who looks for a name in the package finds one class; private ones, seen in one module, do not count."""
    source = "class Pair: 0\nclass _Own: 0\nJson = dict[str, int]\nMOST = 3\nname = 4\n__all__ = []\nOther = Pair"
    assert kinds(source) == ["Pair", "Json", "Other"]
    places: dict[str, list[str]] = {}
    for path in MODULE_FILES:
        for name in kinds(path.read_text(encoding="utf-8")):
            places.setdefault(name, []).append(path.relative_to(ROOT).as_posix())
    assert not {name: files for name, files in places.items() if len(files) > 1}


def test_test_modules_have_names_of_their_own():
    """Pytest imports a test module by the name of its file alone: of two with one name, the second is an error."""
    tests = Path(__file__).parent
    names = Counter(path.name for path in tests.rglob("*.py") if path.name != "conftest.py")
    assert not [name for name, count in names.items() if count > 1]


@pytest.mark.parametrize("module", [WORKER_MODULE, SOLVER_MODULE, MESHING_MODULE, READING_MODULE, *MODULES.values()])
def test_modules_named_by_strings_are_there(module):
    """The check of imports does not see them."""
    assert find_spec(module) is not None


def test_modules_are_named_by_strings_only_where_a_test_looks():
    """Whoever starts or imports a module by a string names it by a constant that the test above resolves."""
    assert MODULES.keys() == FAMILIES.keys()
    by_string = re.compile(r"import_module\(|find_spec\(|\"-m\"|__import__\(")
    starting = {path.stem for path in MODULE_FILES if by_string.search(path.read_text(encoding="utf-8"))}
    known = {"__init__", "errors", "gmsh_process", "known_families", "pool", "vtk_files"}
    assert starting <= known, "resolve the module it names in the test above"


def private_ops(source: str) -> list[str]:
    """The private modules and names of `ops` that a module imports."""
    names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module:
            names += [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
    return [name for name in names if re.match(r"ast_sim\.ops\.(\w+\.)*_", name)]


def test_nothing_outside_imports_a_private_module_of_ops():
    """Import-linter has no wildcard for some modules of a package."""
    for line in ("from ast_sim.ops import linear, _mlp", "from ast_sim.ops._mlp import mlp", "import ast_sim.ops._mlp"):
        assert len(private_ops(line)) == 1, line
    assert not private_ops("from ast_sim.ops.library import Op\nfrom ast_sim.models import _own")
    outside = [path for path in [*MODULE_FILES, *BENCHMARKS] if ROOT / "ops" not in path.parents]
    assert len(outside) > 100 and not [path for path in outside if private_ops(path.read_text(encoding="utf-8"))]


NO_NOUNS = {"found", "asked", "walked", "ways"}  # names that do not say what they hold
MODULES_OF_NUMBERS = {"np", "torch", "math", "time", "nn", "igl", "ipctk"}


def alike(values: list[ast.expr]) -> bool:
    """Whether all values are calls of one function, or of methods of one object."""
    functions = [value.func for value in values if isinstance(value, ast.Call)]
    names = {function.attr if isinstance(function, ast.Attribute) else ast.unparse(function) for function in functions}
    objects = {ast.unparse(f.value) if isinstance(f, ast.Attribute) else "" for f in functions}
    of_one = len(names) == 1 or (len(objects) == 1 and not objects & {"", *MODULES_OF_NUMBERS})
    return len(functions) == len(values) and of_one


def number_kind(value: ast.expr) -> str:
    """Whether a value that the line spells out is a whole number or not; empty for what is no such number."""
    if isinstance(value, ast.Constant):
        return type(value.value).__name__ if type(value.value) in (int, float) else ""
    if isinstance(value, ast.UnaryOp):
        return number_kind(value.operand)
    if not isinstance(value, ast.BinOp):
        return ""
    sides = {number_kind(value.left), number_kind(value.right)}
    if "" in sides:
        return ""
    return "float" if "float" in sides or isinstance(value.op, ast.Div) else "int"


def written_out(value: ast.expr) -> str:
    """The kind of a value that the line spells out: a number, a text, None, a flag, a list, ...; else empty."""
    if kind := number_kind(value):
        return kind
    if isinstance(value, ast.Constant):
        return type(value.value).__name__
    kind = {ast.JoinedStr: "str", ast.ListComp: "List", ast.SetComp: "Set", ast.DictComp: "Dict"}.get(type(value))
    return kind or (type(value).__name__ if isinstance(value, ast.List | ast.Set | ast.Dict | ast.Tuple) else "")


def items_of_one(items: list[ast.Subscript]) -> bool:
    """Whether these are items of one object, or those of several objects at one place."""
    objects = {ast.unparse(item.value) for item in items}
    places = {ast.unparse(item.slice) for item in items}
    return len(objects) == 1 or len(places) == 1


def mixed(values: list[ast.expr]) -> bool:
    """Whether values that one line assigns are unlike, or belong together by nothing that the line shows."""
    kinds = {written_out(value) or type(value).__name__ for value in values}
    if len(kinds) > 1 or kinds & {"IfExp", "BoolOp", "Name", "Attribute"}:
        return True
    if kinds == {"Subscript"}:
        return not items_of_one(values)
    return kinds == {"Call"} and not alike(values)


def swapped(targets: list[ast.expr], values: list[ast.expr]) -> bool:
    """Whether an assignment only changes the order of what stands on its left."""
    return sorted(map(ast.unparse, targets)) == sorted(map(ast.unparse, values))


def side_by_side(node: ast.AST) -> bool:
    """Whether a line assigns several values to several names, attributes or items, which take a line each."""
    if not (isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple)):
        return False
    targets, values = [getattr(side, "elts", []) for side in (node.targets[0], node.value)]
    if not targets or swapped(targets, values):
        return False
    return mixed(values) or not all(isinstance(target, ast.Name) for target in targets)


def folded(source: str) -> list[str]:
    """The assignments of unlike values to several names, and of several values to attributes or items."""
    nodes = [node for node in ast.walk(ast.parse(source)) if side_by_side(node)]
    return [f"{node.lineno}: {ast.unparse(node)}" for node in nodes]


def test_what_is_folded_is_seen():
    """A line may assign several values to names where it shows what makes them one idea: literals of one kind, calls of
    one function or of one object, items of one object or at one place of several, sums of names. It may swap, and it
    may take one value apart: the result of a call, a shape, a generator. All else takes a line each: attributes, names,
    choices (`x if y else z`, `x or y`), values of unlike kinds, and whatever is assigned to attributes or items."""
    choices = ("a, b = x if y else z, u", "a, b = f(x), y or z", "a, b = x or y, u or v")
    beside = ("0, n", "None, 0.0", "None, ''", "[], {}", "[], n", "0, False", "'none', ()", "[i for i in x], y")
    beside += ("x, f'{y}'", "4, 0.1", "-1, 2**23 / 3", "x + 1, y[0]", "x, y", "x.u, y.u", "x.u, x.v", "x[0], y[1]")
    calls = ("a, b = f(x), g(y)", "a, b = 1, g(y)", "a, b = np.zeros(3), np.ones(3)")
    targets = ("self.a, self.b = x, y", "self.a, self.b = 0, 0", "a, self.b = f(x), f(y)", "a[0], a[1] = f(x), f(y)")
    for line in (*calls, *choices, *(f"a, b = {values}" for values in beside), *targets):
        assert len(folded(line)) == 1, line
    alike_values = ("0, 0", "-1, 2 * 3", "0.5, 2 / 3", "[], [1]", "'a', 'b'", "None, None", "(x, 0), (y, 1)")
    alike_values += ("x[0], x[1]", "x[i], y[i]", "x + 1, y * z", "f(x), f(y)", "x.min(), x.max()")
    whole = ("a, b = b, a", "a[i], a[j] = a[j], a[i]", "a, b = f(x)", "a, self.b = f(x)", "a, b = x.shape", "a = x, y")
    for line in (*whole, *(f"a, b = {values}" for values in alike_values)):
        assert not folded(line), line


@pytest.mark.parametrize("path", MODULE_FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_each_line_says_one_thing(path):
    assert not folded(path.read_text(encoding="utf-8")), "one assignment a line"


def without_nouns(source: str) -> list[str]:
    """The uses of names that do not say what they hold."""
    names = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.arg | ast.Name)]
    called = [(node.lineno, node.arg if isinstance(node, ast.arg) else node.id) for node in names]
    return [f"{line}: {name}" for line, name in called if name in NO_NOUNS]


def test_names_without_nouns_are_seen():
    for line in ("found = 1", "a = found", "def f(ways): 0", "[found for found in x]"):
        assert without_nouns(line), line
    assert not without_nouns("'found'\nx.found\nfound_at = 1")


@pytest.mark.parametrize("path", [*MODULE_FILES, *BENCHMARKS], ids=lambda path: path.relative_to(REPOSITORY).as_posix())
def test_names_are_nouns(path):
    """In the package and in the benchmarks; tests may call what they find so."""
    assert not without_nouns(path.read_text(encoding="utf-8")), f"a noun in place of {NO_NOUNS}"


# Pronouns for which a reader must look back, and private words that the field's terms have replaced; the names of old
# options and functions may be quoted.
UNCLEAR = re.compile(
    r"\b(so many|that of|those of|anew|walked|(?<![`-])rivals?)\b|\"ways\"".replace(" ", r"[\s*#]+"), re.I
)
TEXTS = {".c", ".css", ".h", ".html", ".ipynb", ".js", ".json", ".md", ".py", ".pyi", ".toml"}


def test_unclear_words_are_seen():
    for text in ("So many scenes", "that\n * of a plate", "# those\n# of", "Anew.", "a rival", '{"ways": 1}'):
        assert UNCLEAR.search(text), text
    for text in ("it was `rivals`", "`--rivals N`", "so much", "what of", "the body that offers", "in two ways"):
        assert not UNCLEAR.search(text), text


def advice_for_one_caller(source: str) -> list[str]:
    """Texts of errors with an option of the command line, such as --resume, but no argument, such as resume=True. Whole
    commands are advice for both callers."""
    raised = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Raise))
    texts = (
        "".join(part.value for part in ast.walk(node) if isinstance(part, ast.Constant) and isinstance(part.value, str))
        for node in raised
    )
    return [text for text in texts if re.search(r"(?<![\w-])--[a-z]", text) and not re.search(r"ast-sim |\w=", text)]


def test_advice_for_one_caller_is_seen():
    source = "def f():\n    raise E(f'{a}: go on with {b} --resume')\n"
    assert advice_for_one_caller(source) == [": go on with  --resume"]
    assert not advice_for_one_caller(source.replace("--resume", "resume=True (--resume)"))
    assert not advice_for_one_caller(source.replace("--resume", "ast-sim train --resume"))


@pytest.mark.parametrize(
    "path",
    [path for path in MODULE_FILES if path.parent.name != "command_line" and path.name not in ("cli.py", "demo.py")],
    ids=lambda path: str(path.relative_to(ROOT)),
)
def test_errors_advise_callers_of_python_too(path):
    assert not advice_for_one_caller(path.read_text())


def test_texts_name_the_noun():
    """The log keeps the words of its time."""
    folders = [REPOSITORY / name for name in ("ast_sim", "benchmarks", "csrc", "docs", "examples", "tests")]
    paths = [*REPOSITORY.glob("*.md"), *(path for folder in folders for path in folder.rglob("*"))]
    read = {path for path in paths if path.suffix in TEXTS} - {REPOSITORY / "docs" / "log.md", Path(__file__)}
    assert len(read) > 500
    texts = {path.relative_to(REPOSITORY).as_posix(): path.read_text(encoding="utf-8") for path in read}
    bad = [f"{path}: {match[0]}" for path, text in sorted(texts.items()) for match in UNCLEAR.finditer(text)]
    assert not bad, "say the noun, or the term of the field"


def test_lines_of_the_core_are_short():
    """The formatter leaves comments alone, for the sake of the formulas in them."""
    sources = [path for path in (REPOSITORY / "csrc").rglob("*") if path.suffix in (".c", ".h")]
    assert len(sources) > 80
    texts = {path.relative_to(REPOSITORY).as_posix(): path.read_text(encoding="utf-8") for path in sources}
    lines = ((path, *line) for path, text in texts.items() for line in enumerate(text.splitlines(), 1))
    assert not [f"{path}:{number}" for path, number, line in lines if len(line) > 120 or line.startswith("*")]


# The first words of the names of functions in a C file or a header, where it is not the first word of the file's name.
C_FAMILIES = {
    "arguments": ("argument", "call", "check"),
    "attention_block": ("block",),
    "coarsen": ("octree",),
    "elastic_stiffness": ("stiffness",),
    "fps_scan": ("FPS",),
    "pairs": ("octree",),
    "row_tile": ("row", "column"),
    "segment": ("segment", "column"),
    "sparse_conv": ("conv",),
    "sparse_conv_weight": ("conv",),
    "weight_panels": ("dense",),
}
C_WORDS = {"integers", "simd"}  # arithmetic of whole numbers and of vectors, for all kernels
C_FUNCTION = re.compile(r"^(?:static|AST_INLINE)\b[^;=\n]*?\b(\w+)\((?!\()", re.M)


def without_prefix(stem: str, source: str) -> list[str]:
    """The functions of a C file whose names do not say to which family they belong."""
    families = C_FAMILIES.get(stem, (stem.split("_")[0],))
    return [name for name in C_FUNCTION.findall(source) if name.split("_")[0] not in families]


def test_functions_of_the_core_carry_the_prefix_of_their_family():
    """All kernels are one translation unit, and so is the module; their names meet there, those of headers, too. What
    the module does for a kernel has the name of that kernel, or of `call`, or of the attention block."""
    source = "static void pop(stack *s) {\nAST_INLINE vf fps_near(vf x) {\nstatic char *fps_at(void) { f(g); }\n"
    assert without_prefix("fps", source) == ["pop"]
    kernels = set(re.findall(r"KERNEL\((\w+)\)", (REPOSITORY / "csrc" / "ast.h").read_text(encoding="utf-8")))
    for_kernels = {"call", "block", *(name.split("_")[0] for name in kernels)}
    files = sorted(path for path in (REPOSITORY / "csrc").glob("*.[ch]") if path.stem not in C_WORDS)
    names = {path.name: set(without_prefix(path.stem, path.read_text(encoding="utf-8"))) - kernels for path in files}
    names["module_kernels.h"] = {name for name in names["module_kernels.h"] if name.split("_")[0] not in for_kernels}
    assert len(files) > 45 and not {name: functions for name, functions in names.items() if functions}


if __name__ == "__main__":
    rooms = Counter()
    for path in MODULE_FILES:
        rooms[path.relative_to(ROOT).parts[0]] += code_lines(path.read_text(encoding="utf-8"))
    print(
        f"lines of code: {rooms.total():,} in all;",
        ", ".join(f"{room} {count:,}" for room, count in sorted(rooms.items())),
    )
