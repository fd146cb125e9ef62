"""Adaptive Spatial Tokenization (paper, section Overall Architecture), as docs/reference/model.md states it.

    mesh --m2m or e2m--> mesh --M2C--> cells --OCNN--> coarse cells --CrossAttn--> tokens --L_SA x SelfAttn--> tokens
    tokens --CrossAttn--> coarse cells --OCNN transposed--> cells --C2M--> mesh --decoder--> motion (--M2E--> stress)

With `exchanges`, which the paper does not have, nodes attend to tokens directly, not by way of cells. Each time after
the first, the tokens attend to the nodes before:

    mesh --CrossAttn--> tokens --some of the L_SA x SelfAttn--> tokens --CrossAttn--> mesh

Legend: N nodes, E elements, C cells, T tokens.
"""

from __future__ import annotations

from torch import Tensor, nn

from ast_sim.batches.batch_builder import Batch
from ast_sim.batches.graph import Graph
from ast_sim.models.ast.ast_config import ASTConfig
from ast_sim.models.ast.cells import Cells, SparseConv, build_cells, doublings, places
from ast_sim.models.ast.message_passing import MessagePassing
from ast_sim.models.ast.position_embedding import PositionEmbedding, rotations
from ast_sim.models.ast.transformer import AttentionBlock, Vectors
from ast_sim.models.layers import MLP, Linear
from ast_sim.models.node_inputs import edge_features, element_features, element_normalizer, node_features, normalizer_of
from ast_sim.models.normalizer import Normalizer
from ast_sim.models.simulator import Latent, Prediction, Simulator, Use
from ast_sim.ops import farthest_point_sample, segment_mean
from ast_sim.scene import Scene


class AST(Simulator):
    """Adaptive Spatial Tokenization. It has only the parts that the settings ask for."""

    config: ASTConfig

    def __init__(self, config: ASTConfig):
        super().__init__(config)
        c = config
        width = config.hidden
        self.node_inputs = normalizer_of(c, "node")
        self.edge_inputs = normalizer_of(c, "edge")
        self.node_encoder = MLP(self.node_inputs.width, width, width, c.factorized)
        if c.element_inputs:
            self.element_inputs = element_normalizer(c, c.element_inputs)
            self.element_encoder = MLP(self.element_inputs.width, width, width, c.factorized)
            self.e2m = self._message_passing("e2m", self.edge_inputs.width)
        else:
            self.m2m = self._message_passing("m2m", self.edge_inputs.width)
        self.before_cells = self._mesh_steps()
        self.after_cells = self._mesh_steps()
        self.m2c = self._message_passing("m2c")
        self.down = nn.ModuleList(SparseConv(width, up=False) for _ in range(c.l_ocnn))
        self.lift = Linear(width, c.d_token)
        if c.places == "absolute":
            self.position_embedding = PositionEmbedding(c.d_token, c.level - c.l_ocnn)
        self.to_tokens = AttentionBlock(c, c.d_token, c.d_token)
        self.processor = nn.Sequential(*(AttentionBlock(c, c.d_token) for _ in range(c.L_SA)))
        if c.exchanges:
            self.to_nodes = nn.ModuleList(AttentionBlock(c, width, c.d_token) for _ in range(c.exchanges))
            self.from_nodes = nn.ModuleList(AttentionBlock(c, c.d_token, width) for _ in range(c.exchanges - 1))
        else:
            self.to_cells = AttentionBlock(c, c.d_token, c.d_token)
            self.lower = Linear(c.d_token, width)
            self.up = nn.ModuleList(SparseConv(width, up=True) for _ in range(c.l_ocnn))
            self.c2m = self._message_passing("c2m")
        self.decoder = MLP(2 * width, c.decoder_hidden, 3 + c.data.output_columns("node"), c.factorized)
        if on_elements := c.data.output_columns("element"):
            self.m2e = self._message_passing("m2e")
            self.element_decoder = MLP(width, c.decoder_hidden, on_elements, c.factorized)

    def _message_passing(self, name: str, edge_inputs: int = 0) -> MessagePassing:
        return MessagePassing(self.config, edge_inputs, name in self.config.residual)

    def _mesh_steps(self) -> nn.ModuleList:
        steps = (MessagePassing(self.config, self.edge_inputs.width, True) for _ in range(self.config.mesh_steps))
        return nn.ModuleList(steps)

    def graph(self, scene: Scene) -> Graph:
        """See `Simulator`. With element inputs, elements are nodes of the graph too."""
        element_nodes = bool(self.config.element_inputs)
        return Graph.from_scene(scene, element_nodes, **self.config.graph_parts)

    def domain(self, position: Tensor) -> int | None:
        """See `Simulator`: how often the domain must double around its centre to hold the positions [N, 3]."""
        return doublings(self.config, position)

    def inputs_of(self, batch: Batch, use: Use = Normalizer.__call__) -> tuple[Tensor, Tensor, Tensor | None]:
        """See `Simulator`: of the nodes, the edges, and the elements, if they are nodes of the graph."""
        config = self.config
        graph = batch.graph
        now = batch.position
        elements = None
        senders = now
        if config.element_inputs:
            elements = use(self.element_inputs, element_features(config.element_inputs, batch))
            senders = graph.element_mean(now)
        edges = edge_features(graph.edges, graph.rest_edges, senders, now, config.edge_strain)
        return use(self.node_inputs, node_features(config, batch)), use(self.edge_inputs, edges), elements

    def forward(self, batch: Batch) -> Prediction:
        """Normalised outputs for the frame after `batch`."""
        nodes, on_edges, elements = self.inputs_of(batch)
        edges = batch.graph.edges
        encoded = self.node_encoder(nodes)
        if elements is not None:
            elements = self.element_encoder(elements)
            mesh = self.e2m(edges, elements, encoded, on_edges)
        else:
            mesh = self.m2m(edges, encoded, encoded, on_edges)
        for step in self.before_cells:
            mesh = step(edges, mesh, mesh, on_edges)

        now = batch.position
        cells = build_cells(self.config, now, batch.graph.node_offsets, may_grow=not self.training)
        coarse = self._embedded(cells, mesh)
        tokens = self._tokens(cells, coarse)
        if self.config.exchanges:
            nodes = Vectors(mesh, batch.graph.node_offsets, rotations(places(self.config, now), self.config.head_dim))
            mesh, tokens = self._exchange(nodes, tokens)
        else:
            tokens = self.processor(tokens)
            mesh = self._back_to_mesh(cells, self.to_cells(coarse, tokens).x, mesh)
        for step in self.after_cells:
            mesh = step(edges, mesh, mesh, on_edges)

        wanted = self.config.data.output_columns("element") and batch.wants_elements
        on_elements = self.element_decoder(self.m2e(batch.graph.m2e, mesh, elements)) if wanted else None
        latent = Latent(tokens.x, tokens.offsets)
        return Prediction.of(self.config.data, self.decoder(mesh, beside=encoded), on_elements, latent)

    def _embedded(self, cells: Cells, mesh: Tensor) -> Vectors:
        """Mesh features [N, hidden] -> the coarsest cells [C, d_token] with their places."""
        finest = cells.finest
        coarsest = cells.coarsest
        mean = segment_mean(mesh, finest.node_order, finest.node_offsets)
        x = self.m2c(cells.from_mesh(), mesh, mean)
        for convolve, step in zip(self.down, cells.maps, strict=True):
            x = convolve(x, step)
        x = self.lift(x)
        if self.config.places == "absolute":
            return Vectors(self.position_embedding(x, cells.centers()), coarsest.cell_offsets)
        return Vectors(x, coarsest.cell_offsets, rotations(cells.places(), self.config.head_dim))

    def _tokens(self, cells: Cells, coarse: Vectors) -> Vectors:
        """The tokens: some of the coarsest cells, after they have attended to all of them."""
        level = cells.coarsest
        chosen, offsets = farthest_point_sample(level.coordinates(), level.cell_offsets, self.config.num_tokens)
        turned = None if coarse.rotations is None else coarse.rotations.index_select(0, chosen)
        return self.to_tokens(Vectors(coarse.x.index_select(0, chosen), offsets, turned), coarse)

    def _exchange(self, nodes: Vectors, tokens: Vectors) -> tuple[Tensor, Vectors]:
        """Nodes and tokens attend to each other in turn -> mesh features [N, hidden], and the last tokens."""
        blocks, times = len(self.processor), len(self.to_nodes)
        for i, to_nodes in enumerate(self.to_nodes):
            if i:
                tokens = self.from_nodes[i - 1](tokens, nodes)
            tokens = self.processor[blocks * i // times : blocks * (i + 1) // times](tokens)
            nodes = to_nodes(nodes, tokens)
        return nodes.x, tokens

    def _back_to_mesh(self, cells: Cells, x: Tensor, mesh: Tensor) -> Tensor:
        """The coarsest cells [C, d_token] and mesh features [N, hidden] -> mesh features [N, hidden]."""
        x = self.lower(x)
        for convolve, step in zip(self.up, reversed(cells.maps), strict=True):
            x = convolve(x, step)
        return self.c2m(cells.to_mesh(), x, mesh)
