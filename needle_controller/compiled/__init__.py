# SPDX-License-Identifier: Apache-2.0
"""
Compiled functions of control laws, closed loops, observer and steering controller.

====================  ============================================================================
`laws`                control laws on one axis
`quintic`             extreme values of polynomials of fifth order
`loop`                closed loop of a sampled law and the simulated needle
`bending`             bending at a frozen depth, in the coordinates of the observer
`kalman`              steps of the Kalman filter
`filter`              observer: filter and its history
`hypotheses`          steering controller: hypotheses, and their update by tip measurements
`guide_plan`          steering controller: reachable set, and next position of the guide
====================  ============================================================================
"""
