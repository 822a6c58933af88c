"""
Mathematics of a flexible needle in soft tissue, and the plant node around it.

Units are SI throughout; signs and frames are those of docs/architecture.md.
"""

from needle_dynamics.errors import (
    InsertedLengthError,
    JobError,
    NeedleError,
    ParameterError,
    ShapeError,
)
from needle_dynamics.force_sensor import ForceSensor, ForceSensorParameters
from needle_dynamics.integrators import Integrator, Interval, simulate, Trajectory
from needle_dynamics.kernels import FloatArray
from needle_dynamics.model import COORDINATE_NAMES, COORDINATES, NeedleModel
from needle_dynamics.modes import mode_shapes, ModeIntegrals, ModeShapes
from needle_dynamics.parameters import NeedleParameters, PRESETS

__all__ = [
    'COORDINATES',
    'COORDINATE_NAMES',
    'PRESETS',
    'FloatArray',
    'ForceSensor',
    'ForceSensorParameters',
    'InsertedLengthError',
    'Integrator',
    'Interval',
    'JobError',
    'ModeIntegrals',
    'ModeShapes',
    'NeedleError',
    'NeedleModel',
    'NeedleParameters',
    'ParameterError',
    'ShapeError',
    'Trajectory',
    'mode_shapes',
    'simulate',
]
