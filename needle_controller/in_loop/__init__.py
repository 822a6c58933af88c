# SPDX-License-Identifier: Apache-2.0
"""Closed loops in simulation: continuous laws, the sampled controller, and batches of runs."""
