# SPDX-License-Identifier: Apache-2.0
"""
The subcommands of the command line, one per module.

`add_arguments` adds its options to a parser; `run` returns the exit status, and raises a
`JobError` if the job fails, and any other `NeedleError` if an option or an input is not valid.
`SIGNED`, if any, names options whose value may begin with a minus sign; `completed` returns the
words of the command with those that the user left out.
"""
