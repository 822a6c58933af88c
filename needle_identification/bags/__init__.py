"""Bags: recordings on disk, written as MCAP, read in any form that rosbag2 writes."""
