"""Files that are packed, and texts in UTF-16: refused with the cause, whatever their ending says."""

import bz2
import gzip
import io
import lzma
import zipfile

import meshio
import pytest
from data_samples import block

from ast_sim import cli
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.support.errors import DatasetError

CUBE = block(1, 1, 1)
MESH = meshio.Mesh(CUBE.rest_position.astype(float), [("tetra", CUBE.elements)])


def zipped(content):
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        archive.writestr("a", content)
    return made.getvalue()


PACK = {"gzip": gzip.compress, "bzip2": bz2.compress, "xz": lzma.compress, "zip": zipped}


def text_of(folder, ending):
    options = {".vtu": {"binary": False}, ".vtk": {"binary": False}, ".xdmf": {"data_format": "XML"}}
    MESH.write(folder / f"plain{ending}", **options.get(ending, {}))
    return (folder / f"plain{ending}").read_text()


@pytest.mark.parametrize("program", PACK)
@pytest.mark.parametrize("name", ["a.vtu", "a.vtu.packed", "a.inp", "a.bdf", "a.msh"])
def test_packed_files_are_refused_with_the_program(tmp_path, name, program):
    (tmp_path / name).write_bytes(PACK[program](text_of(tmp_path, ".vtu").encode()))
    with pytest.raises(DatasetError, match=f"{name}: is packed by {program}: unpack it first"):
        read_mesh(tmp_path / name)


def test_packed_results_are_refused_by_convert(tmp_path, capsys):
    path = tmp_path / "a.vtu.gz"
    path.write_bytes(gzip.compress(text_of(tmp_path, ".vtu").encode()))
    assert cli.main(["convert", str(path), "--out", str(tmp_path / "a.h5"), "--shares", "1", "0", "0"]) == 2
    assert "a.vtu.gz: is packed by gzip: unpack it first" in capsys.readouterr().err


@pytest.mark.parametrize("order", ["utf-16-le", "utf-16-be"])
@pytest.mark.parametrize(("ending", "read"), [(".inp", True), (".xdmf", True), (".vtk", False), (".bdf", False)])
def test_texts_in_utf_16_are_read_or_refused_with_the_cause(tmp_path, ending, read, order):
    path = tmp_path / f"a{ending}"
    path.write_bytes(("\ufeff" + text_of(tmp_path, ending)).encode(order))
    if read:
        assert len(read_mesh(path).elements) == len(CUBE.elements)
    else:
        with pytest.raises(DatasetError, match=f"a{ending}: is a text in UTF-16: save it as UTF-8"):
            read_mesh(path)
