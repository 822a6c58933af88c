# SPDX-License-Identifier: Apache-2.0
"""
The subcommands of the command line, one per module.

A module has `add_arguments`, which adds its options to a parser, and `run`, which returns the exit
status for the parsed options. `run` raises a `JobError` if the job fails, and any other
`NeedleError` if an option or an input is not valid. The constant `SIGNED`, if any, names options
whose value may begin with a minus sign; the function `completed` returns the words of the command
with those that the user left out.
"""
