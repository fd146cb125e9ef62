"""The models, and the code that they share. What a model of your own needs is imported from here."""

from ast_sim.batches.batch_builder import Batch, Target
from ast_sim.batches.graph import Graph
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.model_config import ModelConfig, Preset, count, setting
from ast_sim.models.node_inputs import node_features, normalizer_of
from ast_sim.models.normalizer import Normalizer
from ast_sim.models.registry import Model
from ast_sim.models.simulator import Latent, Prediction, Simulator
from ast_sim.support.errors import ConfigError

__all__ = [
    "Batch",
    "ConfigError",
    "DataFacts",
    "Graph",
    "Latent",
    "Model",
    "ModelConfig",
    "Normalizer",
    "Prediction",
    "Preset",
    "Simulator",
    "Target",
    "count",
    "node_features",
    "normalizer_of",
    "setting",
]
