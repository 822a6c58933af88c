# SPDX-License-Identifier: Apache-2.0
"""
Control of a flexible needle: laws, references, observer, stability, safety, and closed loops.

Units are SI throughout; signs and frames follow docs/architecture.md.
"""

from typing import TYPE_CHECKING

from needle_ros.lazy import lazy_names

if TYPE_CHECKING:
    from needle_controller.controller import Controller as Controller
    from needle_controller.controller import ControllerOutput as ControllerOutput
    from needle_controller.controller import ControllerSettings as ControllerSettings
    from needle_controller.controller import Measurement as Measurement
    from needle_controller.force_command import ForceCommand as ForceCommand
    from needle_controller.gains import DEFAULT_GAINS as DEFAULT_GAINS
    from needle_controller.gains import LAWS as LAWS
    from needle_controller.hardware import HardwareSettings as HardwareSettings
    from needle_controller.hardware import Robot as Robot
    from needle_controller.in_loop.continuous import run_continuous as run_continuous
    from needle_controller.in_loop.run import LoopRun as LoopRun
    from needle_controller.in_loop.sampled import LoopBatch as LoopBatch
    from needle_controller.in_loop.sampled import run_batch as run_batch
    from needle_controller.in_loop.sampled import run_controller as run_controller
    from needle_controller.laws.continuous import (
        ContinuousInverseDynamics as ContinuousInverseDynamics,
    )
    from needle_controller.laws.continuous import ContinuousPid as ContinuousPid
    from needle_controller.laws.law import Axis as Axis
    from needle_controller.laws.law import Law as Law
    from needle_controller.laws.sampled import Adaptive as Adaptive
    from needle_controller.laws.sampled import AdaptiveGains as AdaptiveGains
    from needle_controller.laws.sampled import InverseDynamics as InverseDynamics
    from needle_controller.laws.sampled import InverseDynamicsGains as InverseDynamicsGains
    from needle_controller.laws.sampled import Pid as Pid
    from needle_controller.laws.sampled import PidGains as PidGains
    from needle_controller.observer.observer import Observer as Observer
    from needle_controller.observer.settings import ObserverSettings as ObserverSettings
    from needle_controller.reference.generator import REFERENCES as REFERENCES
    from needle_controller.reference.quintic import MinimumJerk as MinimumJerk
    from needle_controller.reference.setpoint import Reference as Reference
    from needle_controller.reference.setpoint import ReferenceLimits as ReferenceLimits
    from needle_controller.reference.setpoint import Setpoint as Setpoint
    from needle_controller.safety.safety import SafetyLimits as SafetyLimits
    from needle_controller.stability import check_stability as check_stability
    from needle_controller.stability import Uncertainty as Uncertainty
    from needle_controller.steering.executive import SteeringExecutive as SteeringExecutive
    from needle_controller.steering.law import build_law as build_law
    from needle_controller.steering.law import GuideLaw as GuideLaw
    from needle_controller.steering.law import GuideSetpoint as GuideSetpoint
    from needle_controller.steering.law import STEERING_LAWS as STEERING_LAWS
    from needle_controller.steering.law import SteeringFaultError as SteeringFaultError
    from needle_controller.steering.law import SteeringLaw as SteeringLaw
    from needle_controller.steering.law import TipEstimate as TipEstimate
    from needle_controller.steering.laws.multi_hypothesis import (
        MultiHypothesisLaw as MultiHypothesisLaw,
    )
    from needle_controller.steering.laws.multi_hypothesis import OutOfReachError as OutOfReachError
    from needle_controller.steering.responses import SteeringModel as SteeringModel
    from needle_controller.steering.settings import ExecutiveSettings as ExecutiveSettings
    from needle_controller.steering.settings import SIMULATION_LIMITS as SIMULATION_LIMITS
    from needle_controller.steering.settings import SteeringLimits as SteeringLimits
    from needle_controller.steering.settings import SteeringPrior as SteeringPrior
    from needle_ros.wire import Reading as Reading
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
