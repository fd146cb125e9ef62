"""The parameters of each preset, counted by hand from the tables of docs/reference/model.md.

A factorized layer i -> o has i*o + 2*o parameters (V, g and the bias), a plain one i*o + o, LayerNorm 2*width.
The MLP i -> h -> o has i*h + 2h + h*o + 2o.

Paper, hidden 128:
    node encoder    9 -> 128 -> 128   (type 3, state 3, boundary motion 3)    1408 + 16640          =  18048
    element encoder 3 -> 128 -> 128   (state 3)                                640 + 16640          =  17280
    e2m             edge encoder 8 -> 128 -> 128                               1280 + 16640 = 17920
                    f_e 384 -> 128 -> 128                                     49408 + 16640 = 66048
                    f_v 256 -> 128 -> 128                                     33024 + 16640 = 49664
                    two norms                                                   2 * 256     =   512  = 134144
    m2c, c2m, m2e   f_e 256 -> 128 -> 128: 49664, f_v: 49664, norms: 512                           =  99840
    convolution     27 * 128 * 128 + 128                                                          = 442496
Attention, d tokens, 8 heads of 64:
    q, k, v 3*512*d, out 512*d + d, norm 2d, FFN norm 2d, d*1024 + 1024, 512*d + d          = 3584 d + 6 d + 1024
    self  d = 256: 917504 + 1536 + 1024 = 920064       d = 512: 1835008 + 3072 + 1024 = 1839104
    cross has one norm more (2d):         920576                                        1840128
Embedding: frequencies min(8, level), so 3 (1 + 2 * 5) = 33 inputs at level 5 and 51 at level 8.
"""

from dataclasses import replace

import pytest
import toy

from ast_sim.models.ast.ast_config import ASTConfig
from ast_sim.models.ast.presets import PRESETS
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.registry import build_model

MESH = 18048 + 17280 + 134144 + 2 * 99840  # encoders, e2m, m2c, c2m = 369152

BY_HAND = {
    # lift 128*256+256, embedding 33*256+256, lower 256*128+128; decoder 256 -> 32 -> 4: 8256 + 136
    "deforming_plate": MESH + 33024 + 8704 + 32896 + 2 * 920576 + 12 * 920064 + 8392,
    # no stress: decoder 256 -> 32 -> 3: 8256 + 102
    "sphere_simple": MESH + 33024 + 8704 + 32896 + 2 * 920576 + 12 * 920064 + 8358,
    # nodes have one material scalar more (128); d = 512: lift 66048, embedding 51*512+512, lower 65664
    "abcd": MESH + 128 + 66048 + 26624 + 65664 + 2 * 1840128 + 12 * 1839104 + 8358,
    # elements have material and stress (2 * 128) more; 8 convolutions; m2e; decoder 128 -> 32 -> 1: 4160 + 34
    "abcd_xl": MESH + 256 + 66048 + 26624 + 65664 + 2 * 1840128 + 12 * 1839104 + 8358 + 8 * 442496 + 99840 + 4194,
    # hidden 64, no elements, plain layers: encoder 14 (5 of proximity) -> 64 -> 64: 960 + 4160; m2m: edge encoder
    # 576 + 4160, f_e 12352 + 4160, f_v 8256 + 4160, norms 256; m2c: f_e and f_v 8256 + 4160 each, norms 256; lift 4160;
    # attention, 2 heads of 32: q, k, v 12288, out 4160, norms 256, FFN 16640 + 8256 = 41600, cross 41728, two to
    # tokens, two to nodes; decoder 128 -> 64 -> 4
    "tiny": 5120 + 33920 + 25088 + 4160 + 4 * 41728 + 2 * 41600 + 8256 + 260,
}
TOTALS = {"deforming_plate": 13334088, "sphere_simple": 13334054, "abcd": 26285478, "abcd_xl": 29929608, "tiny": 326916}


def resolved(name: str, **changes) -> ASTConfig:
    """The preset on data of its family's kind; `tiny` on plates."""
    stress = {"deforming_plate": "node", "tiny": "node", "abcd_xl": "element"}.get(name, "none")
    info = replace(toy.info(dynamic=name == "sphere_simple"), stress_location=stress)
    return replace(PRESETS[name].model, **changes).resolve(
        DataFacts.of(info, ("stiffness",) if name.startswith("abcd") else (), 0.1)
    )


@pytest.mark.parametrize("name", PRESETS)
def test_number_of_parameters(name):
    model = build_model(resolved(name))
    assert sum(p.numel() for p in model.parameters()) == BY_HAND[name] == TOTALS[name]


def test_only_what_the_scene_requires_is_built():
    parts = {name: dict(build_model(resolved(name)).named_children()) for name in ("tiny", "abcd")}
    assert "element_encoder" not in parts["tiny"] and "e2m" not in parts["tiny"] and "m2m" in parts["tiny"]
    assert "element_decoder" not in parts["abcd"] and "m2e" not in parts["abcd"] and "m2m" not in parts["abcd"]
    for by_cells in ("position_embedding", "to_cells", "lower", "up", "c2m"):
        assert by_cells not in parts["tiny"] and by_cells in parts["abcd"]
    assert "to_nodes" in parts["tiny"] and "to_nodes" not in parts["abcd"]
    assert len(parts["tiny"]["down"]) == len(parts["abcd"]["up"]) == 0


def test_each_step_on_the_mesh_is_one_more_m2m_before_the_cells_and_one_after():
    config = resolved("tiny", mesh_steps=3)
    assert sum(p.numel() for p in build_model(config).parameters()) == BY_HAND["tiny"] + 2 * 3 * 33920
