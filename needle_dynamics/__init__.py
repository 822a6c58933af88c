"""
Mathematics of a flexible needle in soft tissue, and the plant node around it.

Units are SI throughout; signs and frames are defined in docs/architecture.md.
"""

from typing import TYPE_CHECKING

from needle_ros.lazy import lazy_names

if TYPE_CHECKING:
    from needle_dynamics.analysis import Analysis, analyze
    from needle_dynamics.arrays import FloatArray
    from needle_dynamics.buckling import euler_loads, EulerLoads
    from needle_dynamics.compiled.friction import FRICTION_LAWS
    from needle_dynamics.compiled.integrals import ModeIntegrals
    from needle_dynamics.errors import InsertionDepthError, ToleranceError
    from needle_dynamics.friction import Friction
    from needle_dynamics.linearization import linearize, LinearSystem, operating_point
    from needle_dynamics.model import NeedleModel
    from needle_dynamics.modes import mode_shapes, ModeShapes
    from needle_dynamics.parameters import DEFAULT_PRESET, FORMULATIONS, NeedleParameters, PRESETS
    from needle_dynamics.simulated.batch import Batch, simulate_batch
    from needle_dynamics.simulated.force_sensor import ForceSensor, ForceSensorParameters
    from needle_dynamics.simulated.indenter import Indenter, IndenterParameters
    from needle_dynamics.simulated.integrator import Integrator, Interval
    from needle_dynamics.simulated.plant import Plant
    from needle_dynamics.simulated.trajectory import simulate, Trajectory
    from needle_dynamics.steering.batch import insert_batch
    from needle_dynamics.steering.insertion import Insertion
    from needle_dynamics.steering.needle import NeedlePath, NeedleShape, SteeredNeedle
    from needle_dynamics.steering.parameters import (
        bending_length,
        STEERING_PRESETS,
        SteeringParameters,
        SteeringPreset,
    )
    from needle_dynamics.tissue import Tissue
    from needle_ros.errors import JobError, NeedleError, ParameterError, ShapeError
else:
    __getattr__, __dir__ = lazy_names(__name__)

__all__ = [
    'DEFAULT_PRESET',
    'FORMULATIONS',
    'FRICTION_LAWS',
    'PRESETS',
    'STEERING_PRESETS',
    'Analysis',
    'Batch',
    'EulerLoads',
    'FloatArray',
    'ForceSensor',
    'ForceSensorParameters',
    'Friction',
    'Indenter',
    'IndenterParameters',
    'Insertion',
    'InsertionDepthError',
    'Integrator',
    'Interval',
    'JobError',
    'LinearSystem',
    'ModeIntegrals',
    'ModeShapes',
    'NeedleError',
    'NeedleModel',
    'NeedleParameters',
    'NeedlePath',
    'NeedleShape',
    'ParameterError',
    'Plant',
    'ShapeError',
    'SteeredNeedle',
    'SteeringParameters',
    'SteeringPreset',
    'Tissue',
    'ToleranceError',
    'Trajectory',
    'analyze',
    'bending_length',
    'euler_loads',
    'insert_batch',
    'linearize',
    'mode_shapes',
    'operating_point',
    'simulate',
    'simulate_batch',
]
