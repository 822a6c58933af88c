# SPDX-License-Identifier: Apache-2.0
"""Bags: read and write recordings on disk (rosbag2 MCAP and sqlite3, ROS 1)."""
