"""
Compiled functions, one concept a file.

====================  ============================================================================
`cache`               the decorator of every compiled function; its machine code on disk
`held`                arguments that are converted once, not at each call
`matrices`            Cholesky factor, triangular solutions, eigenvalues of small matrices
`integrals`           the shape modes at the tip and their integrals over the inserted part
`tissue`              layers of tissue
`normal_modes`        modal stiffness, normal modes at a frozen depth, and the row of d
`oscillator`          the damped oscillator and the first-order lag
`friction`            the friction laws, and the motion of the insertion axis under them
`modal_flow`          the deflections through one step
`step`                steps of the integrator, and runs of them
`force_sensor`        samples of the force sensor
`beam`                the needle as a beam about the path that it cut
`cut`                 how it cuts that path, and follows it
`superposition`       the same needle in one plane, for many causes at once
`axis`                motion along the axis: friction per length, cutting, membranes
====================  ============================================================================
"""
