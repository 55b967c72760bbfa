"""DDS is the transport of ROS 2: network, message types, publication of the map. Its adapter is `live.adapters.dds`."""
