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
    from needle_identification.bags.bag import Bag, message_counts, read_topic, Recorded
    from needle_identification.bags.messages import deserialize, encode, message_type
    from needle_identification.bags.topics import BagTopic, OfferedQos
    from needle_identification.bags.writer import BagWriter
    from needle_identification.errors import IdentificationError, RecordingError
    from needle_identification.estimation import ESTIMATORS
    from needle_identification.estimation.estimate import ParameterEstimate, Statistic
    from needle_identification.estimation.regression import regress, Regression
    from needle_identification.friction.estimate import (
        Fit,
        FrictionEstimate,
        FrictionSummary,
        summarize,
    )
    from needle_identification.friction.identify import identify_friction
    from needle_identification.friction.recursive import RecursiveFriction
    from needle_identification.friction.settings import FrictionSettings, TERMS
    from needle_identification.recordings.inspection import inspect_recording, Inspection
    from needle_identification.recordings.reading import (
        read_friction_recording,
        read_indentation_recording,
    )
    from needle_identification.recordings.recording import IndentationRecording, Recording
    from needle_identification.result import write_result
    from needle_identification.steering.estimate import SteeringEstimate
    from needle_identification.steering.identify import identify_steering, SteeringSettings
    from needle_identification.steering.reading import read_steering_recording
    from needle_identification.steering.recording import SteeringRecording
    from needle_identification.stiffness.estimate import (
        LevelEstimate,
        StiffnessEstimate,
        StiffnessSummary,
        summarize_stiffness,
    )
    from needle_identification.stiffness.identify import identify_stiffness
    from needle_identification.stiffness.matrix import asymmetry
    from needle_identification.stiffness.presses import Presses
    from needle_identification.stiffness.settings import StiffnessSettings
else:
    __getattr__, __dir__ = lazy_names(__name__)

__all__ = [
    'ESTIMATORS',
    'TERMS',
    'Bag',
    'BagTopic',
    'BagWriter',
    'Fit',
    'FrictionEstimate',
    'FrictionSettings',
    'FrictionSummary',
    'IdentificationError',
    'IndentationRecording',
    'Inspection',
    'LevelEstimate',
    'OfferedQos',
    'ParameterEstimate',
    'Presses',
    'Recorded',
    'Recording',
    'RecordingError',
    'RecursiveFriction',
    'Regression',
    'Statistic',
    'SteeringEstimate',
    'SteeringRecording',
    'SteeringSettings',
    'StiffnessEstimate',
    'StiffnessSettings',
    'StiffnessSummary',
    'asymmetry',
    'deserialize',
    'encode',
    'identify_friction',
    'identify_steering',
    'identify_stiffness',
    'inspect_recording',
    'message_counts',
    'message_type',
    'read_friction_recording',
    'read_indentation_recording',
    'read_steering_recording',
    'read_topic',
    'regress',
    'summarize',
    'summarize_stiffness',
    'write_result',
]
