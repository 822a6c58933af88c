"""
Recordings of the needle base, and friction identified from them.

Reading, writing and mathematics, without ROS; the nodes are in ``*_node.py``.
"""

from needle_identification.bags.bag import (
    BagWriter,
    check_distinct,
    COMPRESSIONS,
    encode,
    message_counts,
    message_type,
    read_topic,
)
from needle_identification.bags.storage import OfferedQos
from needle_identification.errors import IdentificationError, RecordingError
from needle_identification.estimation.estimate import ParameterEstimate, Statistic, statistic
from needle_identification.estimation.goodness import ResidualTest
from needle_identification.estimation.regression import ESTIMATORS, regress, Regression
from needle_identification.friction.fit import (
    Comparison,
    Fit,
    FrictionEstimate,
    FrictionSummary,
    identify_friction,
    summarize,
)
from needle_identification.friction.recursive import RecursiveFriction
from needle_identification.friction.terms import FrictionSettings, TERMS
from needle_identification.recordings.reading import (
    read_friction_recording,
    read_indentation_recording,
)
from needle_identification.recordings.recording import IndentationRecording, Recording
from needle_identification.result import result_yaml, write_result
from needle_identification.stiffness.fit import (
    identify_stiffness,
    LevelEstimate,
    LevelSummary,
    Presses,
    StiffnessEstimate,
    StiffnessSettings,
    StiffnessSummary,
    summarize_stiffness,
)
from needle_identification.stiffness.spring import asymmetry

__all__ = [
    'COMPRESSIONS',
    'ESTIMATORS',
    'TERMS',
    'BagWriter',
    'Comparison',
    'Fit',
    'FrictionEstimate',
    'FrictionSettings',
    'FrictionSummary',
    'IdentificationError',
    'IndentationRecording',
    'LevelEstimate',
    'LevelSummary',
    'OfferedQos',
    'ParameterEstimate',
    'Presses',
    'Recording',
    'RecordingError',
    'RecursiveFriction',
    'Regression',
    'ResidualTest',
    'Statistic',
    'StiffnessEstimate',
    'StiffnessSettings',
    'StiffnessSummary',
    'asymmetry',
    'check_distinct',
    'encode',
    'identify_friction',
    'identify_stiffness',
    'message_counts',
    'message_type',
    'read_friction_recording',
    'read_indentation_recording',
    'read_topic',
    'regress',
    'result_yaml',
    'statistic',
    'summarize',
    'summarize_stiffness',
    'write_result',
]
