# SPDX-License-Identifier: Apache-2.0
"""
Functions compiled by Numba, grouped by topic.

====================  ============================================================================
`cache`               decorators of compiled functions; loading and compiling of kernels
`boxed`               arguments converted once instead of at each call
`matrices`            Cholesky factor, triangular solutions, eigenvalues of small matrices
`integrals`           shape modes at the tip and their integrals over the inserted part
`tissue`              tissue layers
`normal_modes`        modal stiffness, normal modes at a frozen depth, and axial coupling force
`oscillator`          damped oscillator and first-order lag
`friction`            friction laws and the motion of the insertion axis under them
`own_law`             call of a friction law of a user
`modal_flow`          exact flow of the deflections through one step
`step`                integrator steps and sequences of intervals
`force_sensor`        force sensor samples
`beam`                beam on an elastic foundation about the cut path
`cutting_needle`      needle in the path that its tip has cut: state, tip and shape
`cut`                 motion of such a needle: cutting, withdrawal, reinsertion; batches
`superposition`       planar insertion for many load cases at once
`axis`                axial motion: friction per length, cutting force, membranes
====================  ============================================================================
"""
