"""Models are found by their entry points: lazily, and with one line where that fails."""

import subprocess
import sys

import pytest
from checks import run_python

from ast_sim.models import registry
from ast_sim.models.registry import find_model, find_preset, model_names
from ast_sim.support.errors import ConfigError

BUILT_IN = {"ast", "mgn", "bsms", "hcmt", "transolver"}


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Installs packages of one module with an entry point each, for the time of a test."""
    monkeypatch.syspath_prepend(tmp_path)

    def install(name: str, model: str, code: str) -> None:
        (tmp_path / f"{name}.py").write_text(code)
        information = tmp_path / f"{name}-1.dist-info"
        information.mkdir()
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n")
        (information / "entry_points.txt").write_text(f"[{registry.GROUP}]\n{model} = {name}:MODEL\n")
        forget()

    def forget() -> None:
        sys.modules.pop("odd_package", None)
        registry._entries.cache_clear()
        find_model.cache_clear()

    yield install
    monkeypatch.undo()
    forget()


def test_each_model_has_the_name_that_it_is_registered_by():
    assert set(model_names()) >= BUILT_IN
    for name in BUILT_IN:
        model = find_model(name)
        assert model is find_model(name) and "tiny" in model.presets
        assert all(type(preset.model) is model.config for preset in model.presets.values())


def test_only_the_model_that_is_asked_for_is_imported():
    code = "import sys; from ast_sim.models.registry import find_model, model_names; model_names(); find_model('mgn')"
    imported = run_python(f"{code}; print(*sys.modules)").split()
    assert [name for name in BUILT_IN if f"ast_sim.models.{name}" in imported] == ["mgn"]


def test_a_name_that_there_is_not_names_the_nearest():
    with pytest.raises(ConfigError, match="there is no model 'mgm'; did you mean 'mgn'[?]"):
        find_model("mgm")
    with pytest.raises(ConfigError, match="no preset of mgn 'papre'; did you mean 'paper'[?]"):
        find_preset("mgn", "papre")


def test_without_any_entry_point_the_advice_is_to_install(monkeypatch):
    monkeypatch.setattr(registry, "_entries", lambda: ())
    with pytest.raises(ConfigError, match="there is no model 'new': install ast_sim with pip"):
        find_model("new")


@pytest.mark.parametrize(
    "code, reason",
    [
        ("import absent_module", "ModuleNotFoundError: No module named 'absent_module'"),
        ("MODEL = 3", "odd_package:MODEL is no Model whose settings have the name 'odd'"),
        ("from ast_sim.models.mgn import MODEL", "odd_package:MODEL is no Model whose settings have the name 'odd'"),
    ],
)
def test_a_model_that_cannot_be_imported_names_its_package(package, code, reason):
    package("odd_package", "odd", code)
    with pytest.raises(ConfigError, match=f"the model odd of the package odd_package cannot be imported: .*{reason}"):
        find_model("odd")
    assert find_model("mgn").presets


def test_two_packages_with_one_model_are_told(package):
    package("another_mgn", "mgn", "from ast_sim.models.mgn import MODEL")
    with pytest.raises(ConfigError, match="several packages have a model mgn: another_mgn, ast_sim: uninstall all but"):
        find_model("mgn")


def test_the_help_lists_the_other_models_beside_one_that_cannot_be_imported(package, tmp_path):
    package("odd_package", "odd", "import absent_module")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); from ast_sim.cli import main; main(['train', '--help'])"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "\nthe model odd of the package odd_package cannot be imported: ModuleNotFoundError" in shown
    assert "\nmgn, presets tiny, paper, original:\n" in shown
