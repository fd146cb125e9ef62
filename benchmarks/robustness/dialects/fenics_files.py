"""Series that FEniCS writes: `python3 fenics_files.py WRITER FOLDER COUNT SEED`, WRITER dolfin or dolfinx,
by a Python that has it.

Each of the folders FOLDER/0, FOLDER/1, ... gets files of the writers for VTK and XDMF, and `truth.npz`: points [n, 3],
cells [c, k], displacement [S, n, 3], times [S]. Debian has both packages, `python3-dolfinx` and `python3-dolfin`. This
file imports nothing of the rest.
"""

import sys
from pathlib import Path

import numpy as np


def write_by_dolfinx(folder, rng):
    """A box of tetrahedra or hexahedra."""
    from dolfinx import fem, io, mesh
    from mpi4py import MPI

    cells = rng.integers(1, 4, 3).tolist()
    kind = mesh.CellType.tetrahedron if rng.random() < 0.7 else mesh.CellType.hexahedron
    domain = mesh.create_box(MPI.COMM_SELF, [np.zeros(3), np.array(cells, float)], cells, kind)
    space, plain = (fem.VectorFunctionSpace(domain, ("CG", 1)), fem.FunctionSpace(domain, ("CG", 1)))
    u, fixed = fem.Function(space, name="U"), fem.Function(plain, name="fixed")
    fixed.interpolate(lambda x: (x[0] < 1e-9).astype(float))
    stretch, times = rng.normal(0, 0.1, (3, 3)), np.cumsum(rng.uniform(0.01, 1, 3)) - 0.01
    with io.VTKFile(domain.comm, str(folder / "all.pvd"), "w") as file:
        for frame, time in enumerate(times):
            u.interpolate(lambda x, share=frame / 2: share * stretch.T @ x)
            file.write_function([u, fixed], time)
    with io.XDMFFile(domain.comm, str(folder / "mesh.xdmf"), "w") as file:
        file.write_mesh(domain)
    nodes = domain.geometry.dofmap
    if hasattr(nodes, "array"):
        nodes = nodes.array.reshape(-1, 4 if kind == mesh.CellType.tetrahedron else 8)
    if kind != mesh.CellType.tetrahedron:
        nodes = nodes[:, [0, 1, 3, 2, 4, 5, 7, 6]]  # from lexicographic order
    return domain.geometry.x, nodes, stretch, times


def write_by_dolfin(folder, rng):
    """A box of tetrahedra, whose nodes stand in ascending order: half of them are inside out."""
    import dolfin

    cells = rng.integers(1, 4, 3).tolist()
    domain = dolfin.BoxMesh(dolfin.Point(0, 0, 0), dolfin.Point(*map(float, cells)), *cells)
    space, plain = dolfin.VectorFunctionSpace(domain, "CG", 1), dolfin.FunctionSpace(domain, "CG", 1)
    fixed = dolfin.interpolate(dolfin.Expression("x[0] < 1e-9 ? 1. : 0.", degree=1), plain)
    fixed.rename("fixed", "fixed")
    stretch, times = rng.normal(0, 0.1, (3, 3)), np.cumsum(rng.uniform(0.01, 1, 3)) - 0.01
    rows = [f"s*(a{j}*x[0] + b{j}*x[1] + c{j}*x[2])" for j in range(3)]
    given = {f"{name}{j}": float(stretch[i, j]) for i, name in enumerate("abc") for j in range(3)}
    u = dolfin.Function(space)
    u.rename("U", "U")
    encoding = str(rng.choice(["ascii", "base64", "compressed"]))
    file = dolfin.File(str(folder / "all.pvd"), encoding)
    xdmf = dolfin.XDMFFile(str(folder / "all.xdmf"))
    xdmf.parameters["functions_share_mesh"] = True
    xdmf.parameters["rewrite_function_mesh"] = False
    for frame, time in enumerate(times):
        u.assign(dolfin.interpolate(dolfin.Expression(rows, s=frame / 2, **given, degree=1), space))
        file << (u, float(time))
        xdmf.write(u, float(time))
        xdmf.write(fixed, float(time))
    return domain.coordinates(), domain.cells(), stretch, times


def main(writer, folder, count, seed):
    rng = np.random.default_rng(seed)
    for number in range(count):
        one = folder / str(number)
        one.mkdir(parents=True)
        points, cells, stretch, times = {"dolfin": write_by_dolfin, "dolfinx": write_by_dolfinx}[writer](one, rng)
        displacement = np.arange(3)[:, None, None] / 2 * (points @ stretch)
        np.savez(one / "truth.npz", points=points, cells=cells, displacement=displacement, times=times)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
