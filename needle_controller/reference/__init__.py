# SPDX-License-Identifier: Apache-2.0
"""Reference generator: setpoints over time within limits of speed and acceleration."""
