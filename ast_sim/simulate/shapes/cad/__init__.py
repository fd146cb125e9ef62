"""CAD files, surfaces of triangles, drawn solids: how they are read, mended and meshed. Gmsh has its own process."""
