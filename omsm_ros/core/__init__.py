"""The numbers: pure functions of arrays, without clock, file, print or ROS."""
