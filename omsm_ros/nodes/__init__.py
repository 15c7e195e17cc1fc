"""ROS 2 nodes: parameters, topics, timers and ``main``; every number is decided elsewhere."""
