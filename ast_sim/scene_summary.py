"""What a scene shows of itself: facts, and a drawing in SVG that needs no library."""

from __future__ import annotations

import numpy as np

from ast_sim.element_topology import surface_triangles, unit_normals
from ast_sim.mesh_arrays import NodeType, deforms
from ast_sim.support.errors import counted

MOST_TRIANGLES = 6000  # a drawing of more would be megabytes
WIDTH, HEIGHT = 360, 260
BODY_COLORS = ((76, 139, 201), (224, 160, 60), (90, 168, 118), (176, 124, 198), (201, 106, 90), (127, 140, 153))
EYE = np.array([-0.62, -1.32, 0.78])  # from where a solid scene is seen, in units of its diagonal
LIGHT = np.array([-0.35, -0.45, 0.82])
LIGHT /= np.linalg.norm(LIGHT)


def scene_facts(
    position: np.ndarray, elements: np.ndarray, node_type: np.ndarray, body: np.ndarray, material: np.ndarray | None
) -> dict[str, str]:
    """The numbers of bodies, nodes and elements, the extent and the columns of the material."""
    counts = {kind: int((node_type == kind).sum()) for kind in NodeType}
    types = ", ".join(f"{count:,} {kind.name.lower()}" for kind, count in counts.items() if count)
    extent = " x ".join(f"{length:.4g}" for length in np.ptp(position, axis=0))
    kind = {3: "triangles", 4: "tetrahedra", 10: "second-order tetrahedra"}[elements.shape[1]]
    return {
        "bodies": str(len(np.unique(body))),
        "nodes": f"{len(position):,} ({types})",
        kind: f"{len(elements):,}",
        "extent": extent,
        "material": "none" if material is None else f"{counted(material.shape[1], 'column')}",
    }


def scene_drawing(position: np.ndarray, elements: np.ndarray, node_type: np.ndarray, body: np.ndarray) -> str:
    """The surface in SVG, a colour for each body, obstacles in part transparent; empty if it has too many triangles.

    Triangles are drawn from far to near (painter's algorithm), in parallel projection.
    """
    surface = surface_triangles(position, elements)
    if len(surface) > MOST_TRIANGLES:
        return ""
    planar = elements.shape[1] == 3 and not position[:, 2].any()
    right, up, forward = _axes(planar)
    corners = position[surface].astype(np.float64)  # [F, 3, 3]
    flat = np.stack([corners @ right, corners @ up], axis=2)
    normal = unit_normals(corners)
    facing = np.ones(len(surface), bool) if elements.shape[1] == 3 else normal @ forward < 0
    low, high = flat.min(axis=(0, 1)), flat.max(axis=(0, 1))
    scale = min((WIDTH - 10) / max(high[0] - low[0], 1e-30), (HEIGHT - 10) / max(high[1] - low[1], 1e-30))
    pixels = np.round(5 + (flat - low) * scale, 1)
    pixels[:, :, 1] = np.round(10 + scale * (high[1] - low[1]), 1) - pixels[:, :, 1]
    shade = 0.6 + 0.4 * np.abs(normal @ LIGHT)
    rigid = ~np.all(deforms(node_type)[surface], axis=1)
    lines = []
    for triangle in np.argsort(-(corners.mean(axis=1) @ forward), kind="stable"):
        if facing[triangle]:
            color = BODY_COLORS[int(body[surface[triangle, 0]]) % len(BODY_COLORS)]
            rgb = ",".join(str(int(shade[triangle] * part)) for part in color)
            points = " ".join(f"{x:g},{y:g}" for x, y in pixels[triangle])
            see_through = ' fill-opacity="0.5"' if rigid[triangle] else ""
            lines.append(f'<polygon points="{points}" fill="rgb({rgb})"{see_through}/>')
    tall = 10 + scale * (high[1] - low[1])
    size = f'width="{WIDTH}" height="{tall:.0f}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} stroke="#16202c" stroke-width="0.2">'
    return "".join([head, *lines, "</svg>"])


def _axes(planar: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right, up and forward of the camera, [3] each."""
    forward = np.array([0.0, 0.0, -1.0]) if planar else -EYE / np.linalg.norm(EYE)
    upward = np.array([0.0, 1.0, 0.0]) if planar else np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, upward)
    right /= np.linalg.norm(right)
    return right, np.cross(right, forward), forward
