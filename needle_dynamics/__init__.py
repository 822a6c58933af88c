"""
Mathematics of a flexible needle in soft tissue, and the plant node around it.

Units are SI throughout; signs and frames are those of docs/architecture.md.
"""

from typing import TYPE_CHECKING

from needle_ros.lazy import lazy_names

if TYPE_CHECKING:
    from needle_dynamics.arrays import FloatArray
    from needle_dynamics.compiled.integrals import ModeIntegrals
    from needle_dynamics.errors import (
        InsertedLengthError,
        ToleranceError,
    )
    from needle_dynamics.friction import Friction, FRICTION_LAWS
    from needle_dynamics.model import NeedleModel
    from needle_dynamics.modes import mode_shapes, ModeShapes
    from needle_dynamics.parameters import FORMULATIONS, NeedleParameters, PRESETS
    from needle_dynamics.simulated.force_sensor import ForceSensor, ForceSensorParameters
    from needle_dynamics.simulated.indenter import Indenter, IndenterParameters
    from needle_dynamics.simulated.integrators import (
        Batch,
        Integrator,
        Interval,
        simulate,
        simulate_batch,
        Trajectory,
    )
    from needle_dynamics.tissue import Tissue
    from needle_ros.errors import (
        JobError,
        NeedleError,
        ParameterError,
        ShapeError,
    )
else:
    __getattr__, __dir__ = lazy_names(__name__)

__all__ = [
    'FORMULATIONS',
    'FRICTION_LAWS',
    'PRESETS',
    'Batch',
    'FloatArray',
    'ForceSensor',
    'ForceSensorParameters',
    'Friction',
    'Indenter',
    'IndenterParameters',
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
    'Tissue',
    'ToleranceError',
    'Trajectory',
    'mode_shapes',
    'simulate',
    'simulate_batch',
]
