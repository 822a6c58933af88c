"""
Recordings of the needle base, and friction identified from them.

Reading, writing and mathematics, without ROS; the nodes are in ``*_node.py``.
"""

from needle_identification.bag_io import (
    BagWriter,
    check_distinct,
    COMPRESSIONS,
    encode,
    message_counts,
    message_type,
    OfferedQos,
    read_friction_recording,
    read_topic,
)
from needle_identification.errors import IdentificationError, RecordingError
from needle_identification.friction import (
    FrictionEstimate,
    FrictionSettings,
    FrictionSummary,
    identify_friction,
    Statistic,
    summarize,
)
from needle_identification.recording import Recording
from needle_identification.result import result_yaml, write_result

__all__ = [
    'COMPRESSIONS',
    'BagWriter',
    'FrictionEstimate',
    'FrictionSettings',
    'FrictionSummary',
    'IdentificationError',
    'OfferedQos',
    'Recording',
    'RecordingError',
    'Statistic',
    'check_distinct',
    'encode',
    'identify_friction',
    'message_counts',
    'message_type',
    'read_friction_recording',
    'read_topic',
    'result_yaml',
    'summarize',
    'write_result',
]
