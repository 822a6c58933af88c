"""Control laws of the source in sampled form, references, and the controller node."""

from needle_controller.axis import Axis, SampledLoop, Setpoint
from needle_controller.controller import (
    Command,
    Controller,
    ControllerSettings,
    LAWS,
    Measurement,
)
from needle_controller.inverse_dynamics import InverseDynamics, InverseDynamicsGains
from needle_controller.pid import Pid, PidGains
from needle_controller.reference import MinimumJerk, ReferenceLimits, REFERENCES, Trapezoid
from needle_controller.stability import check_stability, spectral_radius, transition_matrix

__all__ = [
    'LAWS',
    'REFERENCES',
    'Axis',
    'Command',
    'Controller',
    'ControllerSettings',
    'InverseDynamics',
    'InverseDynamicsGains',
    'Measurement',
    'MinimumJerk',
    'Pid',
    'PidGains',
    'ReferenceLimits',
    'SampledLoop',
    'Setpoint',
    'Trapezoid',
    'check_stability',
    'spectral_radius',
    'transition_matrix',
]
