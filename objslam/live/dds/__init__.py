"""DDS, the transport of ROS 2: the network, the message types, and the publication of the map.

The adapter that receives a session's messages over DDS is `live.adapters.dds`.
"""
