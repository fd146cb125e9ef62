"""Files for ParaView, read back with VTK."""

from pathlib import Path

import pyvista
from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline


def read(path: Path) -> tuple[list[float], list[pyvista.DataSet]]:
    """The times and the meshes of a series, with VTK's own readers, which ParaView uses."""
    reader = pyvista.get_reader(path)
    meshes = []
    if path.suffix == ".pvd":
        for index in range(len(reader.time_values)):
            reader.set_active_time_point(index)
            meshes.append(reader.read()[0])
        return list(reader.time_values), meshes
    reader = reader.reader
    reader.UpdateInformation()
    # VTK announces no times for a file of one step.
    times = reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS()) or (0.0,)
    for time in times:
        reader.UpdateTimeStep(time)
        meshes.append(pyvista.wrap(reader.GetOutputDataObject(0)).copy())
    return list(times), meshes
