"""
Control of a flexible needle: laws, references, observer, stability, safety, and closed loops.

Units are SI throughout; signs and frames follow docs/architecture.md.
"""

from needle_controller.admittance import Admittance
from needle_controller.controller import (
    Controller,
    ControllerOutput,
    ControllerSettings,
    DEFAULT_GAINS,
    LAWS,
    Measurement,
)
from needle_controller.force_command import ForceCommand
from needle_controller.hardware import HardwareSettings, Robot
from needle_controller.in_loop.continuous import run_continuous
from needle_controller.in_loop.run import LoopRun
from needle_controller.in_loop.sampled import Commander, LoopBatch, run_batch, run_controller
from needle_controller.laws.adaptive import Adaptive, AdaptiveGains
from needle_controller.laws.axis import Axis
from needle_controller.laws.continuous import (
    ContinuousInverseDynamics,
    ContinuousLaw,
    ContinuousPid,
)
from needle_controller.laws.inverse_dynamics import InverseDynamics, InverseDynamicsGains
from needle_controller.laws.law import Law, no_memory, SampledLoop
from needle_controller.laws.pid import Pid, PidGains
from needle_controller.observer.consistency import Consistency
from needle_controller.observer.observer import Observer
from needle_controller.observer.settings import ObserverSettings
from needle_controller.reference.generator import REFERENCES
from needle_controller.reference.quintic import MinimumJerk
from needle_controller.reference.setpoint import Reference, ReferenceLimits, Setpoint
from needle_controller.reference.trapezoid import Trapezoid
from needle_controller.safety.guard import Guard
from needle_controller.safety.input_monitor import InputMonitor
from needle_controller.safety.limits import SafetyLimits
from needle_controller.stability import (
    check_stability,
    Limit,
    spectral_radius,
    stability_limit,
    transition_matrix,
)
from needle_controller.steering.executive import SteeringExecutive
from needle_controller.steering.law import (
    build_law,
    GuideSetpoint,
    STEERING_LAWS,
    SteeringFaultError,
    SteeringLaw,
    TipEstimate,
)
from needle_controller.steering.laws.multi_hypothesis import MultiHypothesisLaw, OutOfReachError
from needle_controller.steering.limits import SIMULATION_LIMITS, SteeringLimits
from needle_controller.steering.prior import SteeringPrior
from needle_controller.steering.responses import SteeringModel
from needle_controller.steering.settings import ExecutiveSettings
from needle_controller.uncertainty import Uncertainty

__all__ = [
    'DEFAULT_GAINS',
    'LAWS',
    'REFERENCES',
    'SIMULATION_LIMITS',
    'STEERING_LAWS',
    'Adaptive',
    'AdaptiveGains',
    'Admittance',
    'Axis',
    'Commander',
    'Consistency',
    'ContinuousInverseDynamics',
    'ContinuousLaw',
    'ContinuousPid',
    'Controller',
    'ControllerOutput',
    'ControllerSettings',
    'ExecutiveSettings',
    'ForceCommand',
    'Guard',
    'GuideSetpoint',
    'HardwareSettings',
    'InputMonitor',
    'InverseDynamics',
    'InverseDynamicsGains',
    'Law',
    'Limit',
    'LoopBatch',
    'LoopRun',
    'Measurement',
    'MinimumJerk',
    'MultiHypothesisLaw',
    'Observer',
    'ObserverSettings',
    'OutOfReachError',
    'Pid',
    'PidGains',
    'Reference',
    'ReferenceLimits',
    'Robot',
    'SafetyLimits',
    'SampledLoop',
    'Setpoint',
    'SteeringExecutive',
    'SteeringFaultError',
    'SteeringLaw',
    'SteeringLimits',
    'SteeringModel',
    'SteeringPrior',
    'TipEstimate',
    'Trapezoid',
    'Uncertainty',
    'build_law',
    'check_stability',
    'no_memory',
    'run_batch',
    'run_continuous',
    'run_controller',
    'spectral_radius',
    'stability_limit',
    'transition_matrix',
]
