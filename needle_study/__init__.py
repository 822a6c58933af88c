# SPDX-License-Identifier: Apache-2.0
"""Simulate populations of insertions and estimate the distribution of their metrics."""

from typing import TYPE_CHECKING

from needle_ros.lazy import lazy_names

if TYPE_CHECKING:
    from needle_study.study import build_study as build_study
    from needle_study.study import read_study as read_study
    from needle_study.study import Study as Study
    from needle_study.study import StudyTable as StudyTable
    from needle_study.summary import Estimate as Estimate
    from needle_study.summary import probability as probability
    from needle_study.summary import quantile as quantile
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
