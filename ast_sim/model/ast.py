"""Adaptive Spatial Tokenization (paper, section Overall Architecture), as docs/model.md states it.

    mesh --m2m or e2m--> mesh --M2C--> cells --OCNN--> coarse cells --CrossAttn--> tokens --L_SA x SelfAttn--> tokens
    tokens --CrossAttn--> coarse cells --OCNN transposed--> cells --C2M--> mesh --decoder--> motion (--M2E--> stress)

With `exchanges`, which the paper does not have, the nodes learn from the tokens themselves; each time after the first
    mesh --CrossAttn--> tokens --some of the SelfAttn--> tokens --CrossAttn--> mesh

Legend: N nodes, E elements, C cells, T tokens.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from ast_sim.data.batch import Batch
from ast_sim.data.graph import Graph
from ast_sim.data.scene import Scene
from ast_sim.model import features as inputs
from ast_sim.model.ast_config import ASTConfig
from ast_sim.model.cells import Cells, SparseConv, build_cells, doublings, places
from ast_sim.model.linear import Linear
from ast_sim.model.message_passing import MessagePassing
from ast_sim.model.mlp import MLP
from ast_sim.model.simulator import Prediction, Simulator
from ast_sim.model.transformer import AttentionBlock, PositionEmbedding, Vectors, rotations
from ast_sim.ops.fps import farthest_point_sample
from ast_sim.ops.segment import segment_mean


class AST(Simulator):
    """Only what the scene requires is built: element parts with element inputs, convolutions with l_ocnn > 0."""

    config: ASTConfig

    def __init__(self, config: ASTConfig):
        super().__init__(config)
        c, width = config, config.hidden
        self.node_inputs = inputs.normalizer_of(c, "node")
        self.edge_inputs = inputs.normalizer_of(c, "edge")
        self.node_encoder = MLP(self.node_inputs.width, width, width, c.factorized)
        if c.element_inputs:
            self.element_inputs = inputs.normalizer_of(c, "element")
            self.element_encoder = MLP(self.element_inputs.width, width, width, c.factorized)
            self.e2m = self._message_passing("e2m", self.edge_inputs.width)
        else:
            self.m2m = self._message_passing("m2m", self.edge_inputs.width)
        self.before_cells, self.after_cells = self._mesh_steps(), self._mesh_steps()
        self.m2c = self._message_passing("m2c")
        self.down = nn.ModuleList(SparseConv(width, up=False) for _ in range(c.l_ocnn))
        self.lift = Linear(width, c.d_token)
        if c.places == "absolute":
            self.position_embedding = PositionEmbedding(c.d_token, c.L_cell - c.l_ocnn)
        self.to_tokens = AttentionBlock(c, c.d_token, c.d_token)
        self.processor = nn.ModuleList(AttentionBlock(c, c.d_token) for _ in range(c.L_SA))
        if c.exchanges:
            self.to_nodes = nn.ModuleList(AttentionBlock(c, width, c.d_token) for _ in range(c.exchanges))
            self.from_nodes = nn.ModuleList(AttentionBlock(c, c.d_token, width) for _ in range(c.exchanges - 1))
        else:
            self.to_cells = AttentionBlock(c, c.d_token, c.d_token)
            self.lower = Linear(c.d_token, width)
            self.up = nn.ModuleList(SparseConv(width, up=True) for _ in range(c.l_ocnn))
            self.c2m = self._message_passing("c2m")
        self.decoder = MLP(2 * width, c.decoder_hidden, 4 if c.stress == "node" else 3, c.factorized)
        if c.stress == "element":
            self.m2e = self._message_passing("m2e")
            self.element_decoder = MLP(width, c.decoder_hidden, 1, c.factorized)

    def _message_passing(self, name: str, edge_inputs: int = 0) -> MessagePassing:
        return MessagePassing(self.config.hidden, edge_inputs, name in self.config.residual, self.config.factorized)

    def _mesh_steps(self) -> nn.ModuleList:
        c = self.config
        return nn.ModuleList(
            MessagePassing(c.hidden, self.edge_inputs.width, True, c.factorized) for _ in range(c.mesh_steps)
        )

    def graph(self, scene: Scene) -> Graph:
        """See `Simulator`; with element inputs elements are nodes of their own."""
        element_nodes = bool(self.config.element_inputs)
        return Graph.from_scene(scene, element_nodes, surface=self.config.sees_surfaces)

    def domain(self, position: Tensor) -> int | None:
        """How often the domain must double around its centre to hold the positions [N, 3]; see `Simulator`."""
        return doublings(self.config, position)

    def observe(self, batch: Batch) -> None:
        """Add the batch to the statistics of the inputs."""
        self.node_inputs.observe(inputs.node_features(self.config, batch))
        self.edge_inputs.observe(inputs.edge_features(self.config, batch))
        if self.config.element_inputs:
            self.element_inputs.observe(inputs.element_features(self.config, batch))

    def forward(self, batch: Batch) -> Prediction:
        """Normalised outputs for the frame after `batch`."""
        encoded = self.node_encoder(self.node_inputs(inputs.node_features(self.config, batch)))
        elements = None
        edges, edge_features = batch.graph.edges, self.edge_inputs(inputs.edge_features(self.config, batch))
        if self.config.element_inputs:
            elements = self.element_encoder(self.element_inputs(inputs.element_features(self.config, batch)))
            mesh = self.e2m(edges, elements, encoded, edge_features)
        else:
            mesh = self.m2m(edges, encoded, encoded, edge_features)
        for step in self.before_cells:
            mesh = step(edges, mesh, mesh, edge_features)

        now = inputs.present(self.config, batch)
        cells = build_cells(self.config, now, batch.graph.node_offsets, may_grow=not self.training)
        coarse = self._embedded(cells, mesh)
        tokens = self._tokens(cells, coarse)
        if self.config.exchanges:
            nodes = Vectors(mesh, batch.graph.node_offsets, self._rotations(places(self.config, now)))
            mesh = self._exchange(nodes, tokens)
        else:
            mesh = self._back_to_mesh(cells, self.to_cells(coarse, self._process(tokens, self.processor)).x, mesh)
        for step in self.after_cells:
            mesh = step(edges, mesh, mesh, edge_features)

        out = self.decoder(mesh, beside=encoded)
        stress = out[:, 3:] if self.config.stress == "node" else None
        if self.config.stress == "element":
            stress = self.element_decoder(self.m2e(batch.graph.m2e, mesh, elements))
        return Prediction(out[:, :3], stress)

    def _embedded(self, cells: Cells, mesh: Tensor) -> Vectors:
        """Mesh features [N, hidden] -> the coarsest cells, which know their places."""
        finest, coarsest = cells.finest, cells.coarsest
        mean = segment_mean(mesh, finest.node_order, finest.node_offsets)
        x = self.m2c(cells.from_mesh(), mesh, mean)
        for convolve, step in zip(self.down, cells.maps, strict=True):
            x = convolve(x, step)
        x = self.lift(x)
        if self.config.places == "absolute":
            return Vectors(self.position_embedding(x, cells.centers()), coarsest.cell_offsets)
        return Vectors(x, coarsest.cell_offsets, self._rotations(cells.places()))

    def _rotations(self, of: Tensor) -> Tensor:
        return rotations(of, self.config.head_dim)

    def _tokens(self, cells: Cells, coarse: Vectors) -> Vectors:
        """Tokens, which begin as some of the cells and attend to all."""
        level = cells.coarsest
        chosen, offsets = farthest_point_sample(level.coordinates(), level.cell_offsets, self.config.num_tokens)
        turned = None if coarse.rotations is None else coarse.rotations.index_select(0, chosen)
        return self.to_tokens(Vectors(coarse.x.index_select(0, chosen), offsets, turned), coarse)

    def _process(self, tokens: Vectors, blocks: Sequence[AttentionBlock]) -> Vectors:
        for block in blocks:
            tokens = block(tokens)
        return tokens

    def _exchange(self, nodes: Vectors, tokens: Vectors) -> Tensor:
        """Nodes and tokens, which attend to each other in turn -> mesh features [N, hidden]."""
        blocks, times = len(self.processor), len(self.to_nodes)
        for i, to_nodes in enumerate(self.to_nodes):
            if i:
                tokens = self.from_nodes[i - 1](tokens, nodes)
            tokens = self._process(tokens, self.processor[blocks * i // times : blocks * (i + 1) // times])
            nodes = to_nodes(nodes, tokens)
        return nodes.x

    def _back_to_mesh(self, cells: Cells, x: Tensor, mesh: Tensor) -> Tensor:
        """The coarsest cells [C, d_token] and mesh features [N, hidden] -> mesh features."""
        x = self.lower(x)
        for convolve, step in zip(self.up, reversed(cells.maps), strict=True):
            x = convolve(x, step)
        return self.c2m(cells.to_mesh(), x, mesh)
