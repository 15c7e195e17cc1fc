"""Recordings of other programs: columns of text, arrays, TDMS channels, fields of ROS topics."""
