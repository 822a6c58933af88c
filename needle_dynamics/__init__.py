# SPDX-License-Identifier: Apache-2.0
"""
Mathematics of a flexible needle in soft tissue, and the plant node around it.

Units are SI throughout; signs and frames are defined in docs/architecture.md.
"""

from typing import TYPE_CHECKING

from needle_dynamics.compiled.cache import announce_compilation
from needle_ros.lazy import lazy_names

if TYPE_CHECKING:
    from needle_dynamics.analysis import analyze as analyze
    from needle_dynamics.arrays import FloatArray as FloatArray
    from needle_dynamics.compiled.friction import FRICTION_LAWS as FRICTION_LAWS
    from needle_dynamics.errors import InsertionDepthError as InsertionDepthError
    from needle_dynamics.errors import ToleranceError as ToleranceError
    from needle_dynamics.friction import add_friction_law as add_friction_law
    from needle_dynamics.friction import Friction as Friction
    from needle_dynamics.linearization import linearize as linearize
    from needle_dynamics.model import euler_loads as euler_loads
    from needle_dynamics.model import NeedleModel as NeedleModel
    from needle_dynamics.modes import mode_shapes as mode_shapes
    from needle_dynamics.modes import ModeShapes as ModeShapes
    from needle_dynamics.needles import DEFAULT_NEEDLE as DEFAULT_NEEDLE
    from needle_dynamics.needles import find_needle as find_needle
    from needle_dynamics.needles import NEEDLES as NEEDLES
    from needle_dynamics.parameters import FORMULATIONS as FORMULATIONS
    from needle_dynamics.parameters import NeedleParameters as NeedleParameters
    from needle_dynamics.parameters import Tissue as Tissue
    from needle_dynamics.simulated.batch import simulate_batch as simulate_batch
    from needle_dynamics.simulated.integrator import Integrator as Integrator
    from needle_dynamics.simulated.needle_array import NeedleArray as NeedleArray
    from needle_dynamics.simulated.trajectory import simulate as simulate
    from needle_dynamics.simulated.trajectory import Trajectory as Trajectory
    from needle_dynamics.steering.batch import insert_batch as insert_batch
    from needle_dynamics.steering.insertion import Insertion as Insertion
    from needle_dynamics.steering.needle import SteeredNeedle as SteeredNeedle
    from needle_dynamics.steering.parameters import bending_length as bending_length
    from needle_dynamics.steering.parameters import SteeringParameters as SteeringParameters
    from needle_ros.errors import NeedleError as NeedleError
    from needle_ros.errors import ParameterError as ParameterError
    from needle_ros.errors import ShapeError as ShapeError
else:
    # The first simulation on a machine compiles for up to a minute.
    announce_compilation()
    __getattr__, __dir__, __all__ = lazy_names(__name__)
