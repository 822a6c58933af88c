# SPDX-License-Identifier: Apache-2.0
"""Plans of an insertion in a segmented image, without ROS."""
