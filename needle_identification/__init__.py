# SPDX-License-Identifier: Apache-2.0
"""
Identification of friction, stiffness and tissue from recordings at the needle base, without ROS.

A `Recording` is read from a bag (`read_friction_recording`) or built from NumPy arrays.
`identify_friction` and `identify_stiffness` return parameters with confidence intervals;
`summarize` and `summarize_stiffness` combine several recordings. Nodes are in ``*_node.py``.

"The paper" is A. Boroomand, M. Tavakoli, R. Sloboda, N. Usmani, "Dynamical modeling and
controllability analysis of a flexible needle in soft tissue", 2014.
"""

from typing import TYPE_CHECKING

from needle_ros.lazy import lazy_names

if TYPE_CHECKING:
    from needle_identification.bags.bag import Bag as Bag
    from needle_identification.bags.bag import read_bag as read_bag
    from needle_identification.bags.bag import TopicTable as TopicTable
    from needle_identification.bags.writer import BagWriter as BagWriter
    from needle_identification.errors import IdentificationError as IdentificationError
    from needle_identification.errors import RecordingError as RecordingError
    from needle_identification.estimation import ESTIMATORS as ESTIMATORS
    from needle_identification.estimation.estimate import ParameterEstimate as ParameterEstimate
    from needle_identification.estimation.estimate import Statistic as Statistic
    from needle_identification.estimation.regression import regress as regress
    from needle_identification.estimation.regression import Regression as Regression
    from needle_identification.friction.estimate import Fit as Fit
    from needle_identification.friction.estimate import FrictionEstimate as FrictionEstimate
    from needle_identification.friction.estimate import FrictionSummary as FrictionSummary
    from needle_identification.friction.estimate import summarize as summarize
    from needle_identification.friction.identify import identify_friction as identify_friction
    from needle_identification.friction.settings import FrictionSettings as FrictionSettings
    from needle_identification.friction.settings import TERMS as TERMS
    from needle_identification.recordings.inspection import inspect_recording as inspect_recording
    from needle_identification.recordings.inspection import Inspection as Inspection
    from needle_identification.recordings.live import LiveRecording as LiveRecording
    from needle_identification.recordings.reading import (
        read_friction_recording as read_friction_recording,
    )
    from needle_identification.recordings.reading import (
        read_indentation_recording as read_indentation_recording,
    )
    from needle_identification.recordings.recording import (
        IndentationRecording as IndentationRecording,
    )
    from needle_identification.recordings.recording import Recording as Recording
    from needle_identification.recordings.recording import SensorRecording as SensorRecording
    from needle_identification.result import write_result as write_result
    from needle_identification.sensor.identify import identify_sensor as identify_sensor
    from needle_identification.sensor.identify import SensorEstimate as SensorEstimate
    from needle_identification.steering.estimate import SteeringEstimate as SteeringEstimate
    from needle_identification.steering.identify import identify_steering as identify_steering
    from needle_identification.steering.identify import SteeringSettings as SteeringSettings
    from needle_identification.steering.reading import (
        read_steering_recording as read_steering_recording,
    )
    from needle_identification.steering.recording import SteeringRecording as SteeringRecording
    from needle_identification.stiffness.identify import identify_stiffness as identify_stiffness
    from needle_identification.stiffness.identify import LevelEstimate as LevelEstimate
    from needle_identification.stiffness.identify import StiffnessEstimate as StiffnessEstimate
    from needle_identification.stiffness.identify import StiffnessSummary as StiffnessSummary
    from needle_identification.stiffness.identify import summarize_stiffness as summarize_stiffness
    from needle_identification.stiffness.plateaus import StiffnessSettings as StiffnessSettings
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
