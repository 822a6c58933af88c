"""
Compiled functions of laws, closed loops and observer, one concept a file.

====================  ============================================================================
`laws`                the control laws, and the force that gives a wanted velocity
`quintic`             extreme values of polynomials of fifth order
`loop`                one sampled law around the simulated needle
`bending`             the bending at a frozen depth as the observer's state has it
`kalman`              the steps of the Kalman filter
`filter`              the observer's filter and its past
`steering`            one look and one plan of the controller that steers the tip
====================  ============================================================================
"""
