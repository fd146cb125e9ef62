from .dataset.layout import DatasetInfo as DatasetInfo
from .dataset.reader import Dataset as Dataset
from .dataset.writer import DatasetWriter as DatasetWriter
from .importers.convert import convert as convert
from .importers.scene_mesh import read_scene as read_scene
from .inference.answer import Answer as Answer
from .inference.effort import Effort as Effort
from .inference.evaluation.evaluated_run import Evaluation as Evaluation
from .inference.example_run import example_run as example_run
from .inference.trained_run import Run as Run
from .material import Material as Material
from .ops.library import keep_memory as keep_memory
from .ops.library import show_config as show_config
from .prescribed_motion import Motion as Motion
from .prescribed_motion import RigidMotion as RigidMotion
from .scene import NodeType as NodeType
from .scene import Scene as Scene
from .scene import Trajectory as Trajectory
from .simulate.jobs.generate import generate as generate
from .simulate.shapes.simple_bodies import ball as ball
from .simulate.shapes.simple_bodies import box as box
from .simulate.shapes.simple_bodies import cylinder as cylinder
from .simulate.shapes.simple_bodies import plate as plate
from .support.errors import AstSimError as AstSimError
from .training.start import new_model as new_model
from .training.start import train as train

__version__: str
