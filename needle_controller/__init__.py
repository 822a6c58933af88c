"""Control laws of the source in sampled form, references, and the controller node."""

from needle_controller.controller import (
    Command,
    Controller,
    ControllerSettings,
    LAWS,
    Measurement,
)
from needle_controller.laws.axis import Axis, Law, no_memory, Response, SampledLoop, Setpoint
from needle_controller.laws.continuous import (
    ACTUATIONS,
    closed_loop,
    closed_loop_matrix,
    ContinuousInverseDynamics,
    ContinuousLaw,
    ContinuousPid,
)
from needle_controller.laws.inverse_dynamics import InverseDynamics, InverseDynamicsGains
from needle_controller.laws.pid import ANTI_WINDUP, Pid, PidGains
from needle_controller.observer.observer import Consistency, Observer, ObserverSettings
from needle_controller.reference.reference import (
    MinimumJerk,
    ReferenceLimits,
    REFERENCES,
    Trapezoid,
)
from needle_controller.safety import Guard, Refusal, Safety, SafetyLimits, Stream
from needle_controller.stability import (
    check_stability,
    Limit,
    MARGIN,
    spectral_radius,
    stability_limit,
    transition_matrix,
)

__all__ = [
    'ACTUATIONS',
    'ANTI_WINDUP',
    'LAWS',
    'MARGIN',
    'REFERENCES',
    'Axis',
    'Command',
    'Consistency',
    'ContinuousInverseDynamics',
    'ContinuousLaw',
    'ContinuousPid',
    'Controller',
    'ControllerSettings',
    'Guard',
    'InverseDynamics',
    'InverseDynamicsGains',
    'Law',
    'Limit',
    'Measurement',
    'MinimumJerk',
    'Observer',
    'ObserverSettings',
    'Pid',
    'PidGains',
    'ReferenceLimits',
    'Refusal',
    'Response',
    'Safety',
    'SafetyLimits',
    'SampledLoop',
    'Setpoint',
    'Stream',
    'Trapezoid',
    'check_stability',
    'closed_loop',
    'closed_loop_matrix',
    'no_memory',
    'spectral_radius',
    'stability_limit',
    'transition_matrix',
]
