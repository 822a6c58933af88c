# SPDX-License-Identifier: Apache-2.0
"""Claims of the paper with computed verdict and evidence."""

from reproduction.claims.claim import Claim, FAILS, HOLDS, ONLY_IF, Tables
from reproduction.claims.judge import judge_claims, section

__all__ = ['FAILS', 'HOLDS', 'ONLY_IF', 'Claim', 'Tables', 'judge_claims', 'section']
