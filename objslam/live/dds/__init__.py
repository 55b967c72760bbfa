"""DDS, the transport of ROS 2: the network, the types on it, and the map published there.

The adapter that feeds a session from it is `live.adapters.dds`.
"""
